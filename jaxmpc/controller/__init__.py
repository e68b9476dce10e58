"""Controllers: state, measurement, step, plan."""
