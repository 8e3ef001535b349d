"""Settings of the training loop."""

from dataclasses import dataclass, field
from fractions import Fraction

from midway.errors import ConfigurationError
from midway.settings import check, setting
from midway.types import RelabelMix

RESTART = "restart"
"""What `TrainConfig.on_env_error` may be instead of ``stop``."""

LARGEST = 10**12
"""Bound of counts: more could not be run or stored."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of the training loop; the defaults are those of the paper's ant navigation."""

    steps: int = setting(1_000_000, "appendix D", "environment steps", least=1, most=LARGEST)
    num_envs: int = setting(1, "original code", "parallel environments K", least=1, most=100_000)
    random_steps: int = setting(
        10_000, "original code", "uniform actions before the first update", least=1, most=LARGEST
    )
    updates_per_step: float = setting(
        1.0, "table 1", "update-to-data ratio, kept exactly", least=1e-4, most=1_000
    )
    batch_size: int = setting(2048, "table 1", "transitions", least=1, most=10**7)
    encoder_batch_size: int = setting(
        0, "not in the paper", "the same while images are encoded; 0: batch_size", least=0
    )
    replay_capacity: int = setting(
        1_000_000, "table 1", "rows; an episode of T steps takes T + 2", least=1, most=LARGEST
    )
    relabel: RelabelMix = field(default_factory=RelabelMix)
    freeze_encoder_after: int = setting(
        0, "not in the paper", "updates of the image encoder; 0: all", least=0, most=LARGEST
    )
    evaluate_every: int = setting(10_000, "ours", "environment steps", least=1)
    evaluation_episodes: int = setting(
        20,
        "ours",
        "for each task and kind of action",
        least=1,
        most=100_000,
        deviates="5 of the original code are too few to tell curves apart",
    )
    log_every: int = setting(1_000, "ours", "environment steps", least=1)
    checkpoint_every: int = setting(50_000, "ours", "environment steps", least=1)
    collect_limit: int = setting(
        0, "not in the paper", "steps of an episode in collection; 0: the environment's", least=0
    )
    collect: bool = setting(True, "ours", "whether steps are taken, or counted only")
    on_env_error: str = setting(
        "stop",
        "ours",
        "what a broken environment of others does: stop the run, or restart",
        choices=("stop", RESTART),
    )
    devices: int = setting(1, "ours", "accelerators that batch and replay are split over", least=1)
    stop_at: float = setting(
        0.0, "not in the paper", "success that ends the run; 0: none", least=0, most=1
    )
    task: str = setting("uniform", "appendix C", "starts and goals that are trained on")

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigurationError: A value is not allowed, or rows cannot be divided over devices.
        """
        check(self)
        if self.random_steps < self.num_envs:
            raise ConfigurationError(
                f"random_steps {self.random_steps}: at least one step of each of the "
                f"{self.num_envs} environments must come before the first update"
            )
        for name in ("num_envs", "batch_size", "encoder_batch_size"):
            if getattr(self, name) % self.devices:
                raise ConfigurationError(
                    f"{name} {getattr(self, name)}: must be a multiple of devices {self.devices}"
                )

    @property
    def update_ratio(self) -> Fraction:
        """Updates per environment step as an exact fraction."""
        return Fraction(self.updates_per_step).limit_denominator(10_000)

    @property
    def updates_per_call(self) -> int:
        """Updates of one compiled call: those due after a step of every environment."""
        return max(1, int(self.num_envs * self.update_ratio))

    def updates_due(self, steps: int) -> int:
        """Return how many updates belong to this many environment steps."""
        return int(max(0, steps - self.random_steps) * self.update_ratio)
