"""What counts as what in the statements of the thesis; `rows.toml` writes these numbers by their names."""

from studies.thesis.reach import NEAR_CLOSED as NEAR_CLOSED

STATIONARY = 0.25  # deadzone half widths of mean deviation that count as arrived
PRECISE = 0.1  # half widths of deviation that count as none
LATE = 600.0  # s at the end of a stretch that stand for what it settles at
HUNTING = 3  # reversals in the second half of a window that count as oscillation: more than a swing and back
NEARLY_CLOSED = 20.0  # % choke
OUT_OF_REACH = 0.1  # half widths between a setpoint pair and the nearest steady state of the plant
ALIKE = 1.25  # ratio of mean deviations up to which one performance closely resembles another
FAR_MORE = 1.5  # times the travel, or the predicted response
STEP = 2.0  # %, a move of the choke
FULL = 1e-3  # of the range of an MV, for "at its limit"
REST = 10.0  # m3/h, changes of the lift below that are rest
FAR = 10.0  # half widths, far outside the deadzone
MOST = 40  # turns of the choke to look at
FIRST = 600.0  # s after a step of the setpoints that are its beginning
PLAN_ALIKE = 10.0  # % of a setpoint step: difference of two responses that count as alike
FASTER = 7.0  # times, 29 against 4 minutes in the thesis
ITERATION = 0.1  # s
SAME = 0.1  # half widths of difference between two responses that cannot be told apart in a figure
SLOWER = 2.0  # times that count as significantly longer
SPIKE = 10.0  # times the median of a step
