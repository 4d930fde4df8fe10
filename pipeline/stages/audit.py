"""Stage audit: does a result rest on test rows? Folds, scalers and the choice of settings, looked at once more."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline import io
from pipeline.errors import LeakError, complain
from pipeline.evaluation.audit.checks import Check, holds, to_words
from pipeline.evaluation.audit.settings import audit_choice, audit_scaler
from pipeline.evaluation.audit.sides import Labels, Sides, audit_fold
from pipeline.learning.inputs import VIEW
from pipeline.learning.recipe import HEADLINE, Recipe
from pipeline.learning.standardise import FIT
from pipeline.seeds import rng_for
from pipeline.stages._run import run, say
from pipeline.stages._train import Scenery, read_scenery
