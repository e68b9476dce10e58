"""Controllers: state, measurement, step, plan, targets (6.20)."""
