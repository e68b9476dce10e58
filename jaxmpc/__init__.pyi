"""What type checkers and editors see of the package, whose names are loaded when first used."""

from jaxmpc.controller.checkpoint import load_controller as load_controller
from jaxmpc.controller.checkpoint import save_controller as save_controller
from jaxmpc.controller.controller import Controller as Controller
from jaxmpc.controller.controller import Controllers as Controllers
from jaxmpc.controller.measurement import SensorFault as SensorFault
from jaxmpc.controller.measurement import fault_errors as fault_errors
from jaxmpc.controller.plan import solve_plan as solve_plan
from jaxmpc.controller.targets import TargetController as TargetController
from jaxmpc.errors import InputError as InputError
from jaxmpc.loop.reference import Reference as Reference
from jaxmpc.loop.simulate import simulate as simulate
from jaxmpc.loop.simulate import simulate_batch as simulate_batch
from jaxmpc.loop.simulate import simulate_batches as simulate_batches
from jaxmpc.loop.trajectory import Trajectory as Trajectory
from jaxmpc.model.step_response import StepResponseModel as StepResponseModel
from jaxmpc.model.step_response import make_model as make_model
from jaxmpc.problem.structure import Structure as Structure
from jaxmpc.problem.tuning import make_tuning as make_tuning
from jaxmpc.problem.tuning import stack_tunings as stack_tunings
from jaxmpc.process.actuator import Actuator as Actuator
from jaxmpc.process.function_plant import FunctionPlant as FunctionPlant
from jaxmpc.process.model_plant import ModelPlant as ModelPlant
from jaxmpc.process.plant import Parameter as Parameter
from jaxmpc.process.well.plant import WellPlant as WellPlant
from jaxmpc.steady.map import SteadyMap as SteadyMap
from jaxmpc.steady.optimise import optimise as optimise
