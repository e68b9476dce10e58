"""What the benchmark measures, one module per section; each yields its rows as they are measured."""
