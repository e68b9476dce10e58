"""From logged data to a step-response model: reading (`read_log`), estimation and judgement (`identify_log`)."""

from identify.logged.identify import identify_log as identify_log
from identify.logged.log import Log as Log
from identify.logged.log import read_log as read_log
