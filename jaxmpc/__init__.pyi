"""What type checkers and editors see of the package, whose names are loaded when first used."""

from jaxmpc.batch import controller_batch as controller_batch
from jaxmpc.checkpoint import load_controller as load_controller
from jaxmpc.checkpoint import save_controller as save_controller
from jaxmpc.closed_loop import simulate as simulate
from jaxmpc.closed_loop import simulate_batch as simulate_batch
from jaxmpc.closed_loop import simulate_batches as simulate_batches
from jaxmpc.controller import ContinuousController as ContinuousController
from jaxmpc.errors import InputError as InputError
from jaxmpc.measurement import SensorFault as SensorFault
from jaxmpc.measurement import fault_errors as fault_errors
from jaxmpc.mixed_integer import MixedIntegerController as MixedIntegerController
from jaxmpc.mixed_integer import MixedIntegerControllers as MixedIntegerControllers
from jaxmpc.plan import solve_plan as solve_plan
from jaxmpc.plant import WellPlant as WellPlant
from jaxmpc.reference import Reference as Reference
from jaxmpc.rto import optimise as optimise
from jaxmpc.steady_map import SteadyMap as SteadyMap
from jaxmpc.step_response import StepResponseModel as StepResponseModel
from jaxmpc.step_response import make_model as make_model
from jaxmpc.structure import Structure as Structure
from jaxmpc.targets import TargetController as TargetController
from jaxmpc.trajectory import Trajectory as Trajectory
from jaxmpc.tuning import make_tuning as make_tuning
from jaxmpc.tuning import stack_tunings as stack_tunings
