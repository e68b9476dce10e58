"""The edge between the mathematics and the machine: what a compiled program needs around it, behind one door for each.

- `compilation`: pauses in which something is compiled are said (`compiling_for`, `told`, `say`).
- `clock`: time that passes while nothing is compiled (`Clock`).
- `cache`: the private folder of what was built (`cache_folder`, `sealed`, `read_sealed`).
- `threads`: compiled programs side by side on the cores (`cores`, `parts_of`, `side_by_side`).
- `packing`: many small arrays as one between host and device (`Packing`, `flattened`, `rebuilt`).
- `interrupts`: Ctrl-C on the command line (`front_door`, `report`, `held`, `last_words`, `in_the_end`,
  `before_leaving`, `being_left`, `run_program`).
- `numerics`: what XLA computes otherwise than one would think (`largest`).

Everything else in them is theirs. Nothing is imported here: Ctrl-C is watched before JAX is loaded (`interrupts`).
"""
