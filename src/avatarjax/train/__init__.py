"""Training: a state pytree, one jitted step, a loop that resumes, and logs that people can read."""

from avatarjax.train.loop import fit, read_metrics
from avatarjax.train.stage import Run, StageConfig, train_stage
from avatarjax.train.state import TrainState, make_step, new_state, weights

__all__ = [
    "Run",
    "StageConfig",
    "TrainState",
    "fit",
    "make_step",
    "new_state",
    "read_metrics",
    "train_stage",
    "weights",
]
