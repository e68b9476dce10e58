"""The process of the thesis, and the names of its variables."""

from __future__ import annotations

from jaxmpc.process.file import load_process

CHOKE, LIFT = "choke", "gas_lift"
GAS, OIL = "gas_rate", "oil_rate"
WELL = load_process("gas-lifted-well")
