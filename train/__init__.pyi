import logging

from train.auditing.network import AuditReport as AuditReport
from train.checkpoints import load_run as load_run
from train.command_settings import AuditSettings as AuditSettings
from train.command_settings import EvaluateSettings as EvaluateSettings
from train.command_settings import LabSettings as LabSettings
from train.commands.audit import audit as audit
from train.commands.evaluate import evaluate as evaluate
from train.commands.harden import harden as harden
from train.publication import load as load
from train.publication import publish as publish
from train.settings import DataSettings as DataSettings
from train.settings import EvaluationSettings as EvaluationSettings
from train.settings import ExperimentSettings as ExperimentSettings
from train.settings import ModelSettings as ModelSettings
from train.settings import TrainingSceneSettings as TrainingSceneSettings
from train.settings import TrainSettings as TrainSettings

console: logging.Logger
__version__: str
