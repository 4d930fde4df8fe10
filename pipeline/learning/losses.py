"""The L2 loss on (x, y, F). In: answers and truths, scaled. Out: one number to descend. Knows no optimiser."""

import torch
from jaxtyping import Float


def squared_error(answer: Float[torch.Tensor, "b 3"], truth: Float[torch.Tensor, "b 3"]) -> Float[torch.Tensor, ""]:
    """Mean of squared errors over all known targets of a batch; an unknown target (NaN) pulls nowhere."""
    known = ~torch.isnan(truth)
    # Fill before the difference: NaN times zero is NaN, in the gradient too.
    difference = torch.where(known, answer - torch.where(known, truth, answer.detach()), 0.0)
    return (difference**2).sum() / known.sum()
