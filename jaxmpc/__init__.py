"""Model predictive control with discrete actuators, from a step-response model.

Importing the package switches JAX to float64: pruning integer decisions needs bounds that are right to
1e-6, and float32 bounds are not. It also turns on JAX's persistent compilation cache, so that a second
process starts without compiling; set ``JAX_COMPILATION_CACHE_DIR`` to move it or ``JAXMPC_NO_JIT_CACHE=1``
to leave it off.
"""

import os as _os
from pathlib import Path as _Path

import jax as _jax

_jax.config.update("jax_enable_x64", True)
if not _os.environ.get("JAX_COMPILATION_CACHE_DIR") and not _os.environ.get("JAXMPC_NO_JIT_CACHE"):
    _cache = _Path(_os.environ.get("JAXMPC_CACHE") or _Path.home() / ".cache" / "jaxmpc") / "jit"
    _jax.config.update("jax_compilation_cache_dir", str(_cache))
    _jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
