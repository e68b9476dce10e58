"""The front door: one file per group of commands; the only place that may import upwards."""
