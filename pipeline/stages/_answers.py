"""What the experiments with adapted networks share: their answers on a skin's rows, before and after. Knows no argv."""

from collections.abc import Iterator, Sequence

from pipeline.dataset.splits import Fold
from pipeline.evaluation.adapted import BEFORE, Answered
from pipeline.evaluation.tally import tally
from pipeline.learning.card import went
from pipeline.learning.cell import Cell
from pipeline.learning.executors import device
from pipeline.learning.inputs import VIEW
from pipeline.learning.recipe import Adaptation
from pipeline.stages._adapt import Starts, own_starts
from pipeline.stages._models import note_seconds
from pipeline.stages._train import Scenery, train_all


def answers_before(at: Scenery, fold: Fold, settings: Adaptation, starts: Starts, skin: str) -> Iterator[Answered]:
    """Answer on a skin's tested rows as the networks do before they are adapted."""
    from pipeline.learning.model import Predictor  # torch, late: only a stage that answers pays for it

    recipe, test = at.asked.train_triplet.recipes[settings.base], fold.test[at.rows.skin[fold.test] == skin]
    view = VIEW[recipe.inputs](at.rows.db_uT[test])
    for seed_i, start in own_starts(starts, settings.base, fold).items():
        predict = Predictor(start.weights, recipe.architecture, device())
        predicted = start.scaler.decode(predict(start.scaler.encode(view)))
        yield Answered(BEFORE, str(at.rows.board[test[0]]), skin, seed_i, at.rows.target[test], predicted)


def answers_after(at: Scenery, cells: Sequence[tuple[str, Cell]], stage: str) -> tuple[list[Answered], dict[str, int]]:
    """Adapt by (arm, cell), and answer on each cell's tested rows; count what collapsed."""
    own = [cell for _, cell in cells]
    trained = train_all(at, own, stage)
    note_seconds(at.scene, stage, own, trained)
    answered = [
        Answered(
            arm, str(at.rows.board[cell.test[0]]), cell.skin, cell.seed_i, at.rows.target[cell.test], one.predicted
        )
        for (arm, cell), one in zip(cells, trained, strict=True)
    ]
    return answered, tally(map(went, trained))
