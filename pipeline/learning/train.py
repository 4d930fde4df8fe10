"""The one training loop. In: scaled rows, a recipe, a generator. Out: a trained network and its loss curve.

Read it from top to bottom. Refuses to know folds, files and scores.
"""

import torch
from jaxtyping import Float

from pipeline.errors import TrainingError, complain
from pipeline.learning.losses import squared_error
from pipeline.learning.model import BUILD, SkinNet
from pipeline.learning.recipe import Recipe


def train(
    inputs: Float[torch.Tensor, "n ch"],
    targets: Float[torch.Tensor, "n 3"],
    recipe: Recipe,
    generator: torch.Generator,
) -> tuple[SkinNet, list[float]]:
    """Descend the L2 loss; return the network and the mean loss of every epoch (scaled units).

    Batches are drawn without replacement, the last short one of an epoch is left to the next shuffle. AdamW under a
    one-cycle rate: both are our choice, the paper names neither.
    """
    net = BUILD[recipe.architecture](inputs.shape[1], generator)
    batch_n = min(recipe.batch_n, len(inputs))
    steps_n = len(inputs) // batch_n
    optimizer = torch.optim.AdamW(net.parameters(), lr=recipe.rate_max, weight_decay=recipe.weight_decay, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, recipe.rate_max, total_steps=max(recipe.epochs_n * steps_n, 2)
    )
    curve = []
    for epoch_i in range(recipe.epochs_n):
        order = torch.randperm(len(inputs), generator=generator)
        total = torch.zeros(())
        for batch in order[: steps_n * batch_n].split(batch_n):  # [b]
            loss = squared_error(net(inputs[batch]), targets[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += loss.detach()
        curve.append(float(total) / steps_n)
        if not torch.isfinite(total):
            raise TrainingError(
                complain(
                    f"epoch {epoch_i + 1}",
                    "the loss",
                    "finite",
                    curve[-1],
                    f"Lower rate_max ({recipe.rate_max:g}), or look at the rows.",
                )
            )
    return net, curve


@torch.no_grad()
def predict(net: SkinNet, inputs: Float[torch.Tensor, "n ch"]) -> Float[torch.Tensor, "n 3"]:
    """Answer for many rows, a block at a time to bound memory."""
    return torch.cat([net(block) for block in inputs.split(65_536)])
