"""What the experiments with adapted networks share: their answers on a skin's rows, before and after. Knows no argv."""

from collections.abc import Iterator, Sequence

from pipeline.core.executors import device
from pipeline.dataset.splits import Fold
from pipeline.evaluation.tally import tally
from pipeline.learning.card import collapse_record
from pipeline.learning.inputs import VIEW
from pipeline.learning.recipe import Adaptation, training
from pipeline.learning.trial import Trial
from pipeline.trials.adapting import Starts, own_starts
from pipeline.trials.arms import BEFORE, Answered
from pipeline.trials.data import SceneData, train_all
from pipeline.trials.models import note_seconds


def answers_before(data: SceneData, fold: Fold, settings: Adaptation, starts: Starts, skin: str) -> Iterator[Answered]:
    """Answer on a skin's tested rows as the networks do before they are adapted."""
    from pipeline.learning.model import Predictor  # torch, late: only a stage that answers pays for it

    recipe = training(data.settings, "train_triplet").recipes[settings.base]
    test = fold.test[data.rows.skin[fold.test] == skin]
    view = VIEW[recipe.inputs](data.rows.db_uT[test])
    for seed_i, start in own_starts(starts, settings.base, fold).items():
        predict = Predictor(start.weights, recipe.architecture, device())
        predicted = start.scaler.decode(predict(start.scaler.encode(view)))
        yield Answered(BEFORE, str(data.rows.board[test[0]]), skin, seed_i, data.rows.target[test], predicted)


def answers_after(
    data: SceneData, trials: Sequence[tuple[str, Trial]], stage: str
) -> tuple[list[Answered], dict[str, int]]:
    """Adapt by (arm, trial), and answer on each trial's tested rows; count what collapsed."""
    own = [trial for _, trial in trials]
    trained = train_all(data, own, stage)
    note_seconds(data.scene, stage, own, trained)
    answered = [
        Answered(
            arm,
            str(data.rows.board[trial.test[0]]),
            trial.skin,
            trial.seed_i,
            data.rows.target[trial.test],
            one.predicted,
        )
        for (arm, trial), one in zip(trials, trained, strict=True)
    ]
    return answered, tally(map(collapse_record, trained))
