"""Studies: definitions, runner, results store, key figures and reports."""
