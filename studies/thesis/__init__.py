"""The comparisons and claims of the thesis."""
