"""The work of the commands as functions: from logs to a report, with one setup."""

from jaxid.validation.contact_flags import check_contacts as check_contacts

from .excitation_settings import Excitation as Excitation, Leads as Leads
from .force_sensor_payload import ForceSensor as ForceSensor
from .geometry_calibration import (
    CalibrationSettings as CalibrationSettings,
    TorqueLogs as TorqueLogs,
    calibrate_from_files as calibrate_from_files,
)
from .log_identification import (
    IdentificationReport as IdentificationReport,
    identify_logs as identify_logs,
)
from .log_inspection import Inspection as Inspection, inspect_logs as inspect_logs
from .log_loading import load_log as load_log, read_log as read_log
from .log_rollout import (
    ServoSettings as ServoSettings,
    TorqueSettings as TorqueSettings,
    identify_rollout_from_logs as identify_rollout_from_logs,
)
from .motion_design import (
    MotionTask as MotionTask,
    design_motion as design_motion,
    prepare_motion as prepare_motion,
    write_best_motion as write_best_motion,
    write_design as write_design,
)
from .payload_gains_and_states import (
    identify_gains_from_logs as identify_gains_from_logs,
    identify_payload_from_logs as identify_payload_from_logs,
    identify_states_from_logs as identify_states_from_logs,
)
from .report_agreement import agree_reports as agree_reports
from .robot_file import RobotFile as RobotFile
from .setup import LogReading as LogReading, Setup as Setup
from .surroundings import Collision as Collision
