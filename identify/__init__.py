"""From plants to step-response models: the well as an FMU, step tests, steady-state sweeps, parameter fits.

Implements thesis 3.2 (the FMU) and chapter 4 (the prediction model). Imports `jaxmpc`, never the reverse.
"""
