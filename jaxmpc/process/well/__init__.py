"""The gas-lifted well of the thesis."""
