"""What type checkers and editors see of the package, whose names are loaded when first used."""

from figures.show import pareto as pareto
from figures.show import plot as plot
