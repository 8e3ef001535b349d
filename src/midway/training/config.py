"""Settings of the training loop."""

from dataclasses import dataclass, field
from fractions import Fraction

from midway.errors import ConfigurationError
from midway.settings import check, setting
from midway.types import EnvSpec, RelabelMix

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
    encoder_updates_per_step: float = setting(
        0.0,
        "not in the paper",
        "the same while images are encoded; 0: updates_per_step",
        least=0,
        most=1_000,
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

    def update_ratio(self, encoding: bool) -> Fraction:
        """Return updates per environment step as an exact fraction, of at least 1 / 10,000."""
        ratio = (self.encoder_updates_per_step if encoding else 0) or self.updates_per_step
        return max(Fraction(ratio).limit_denominator(10_000), Fraction(1, 10_000))

    def updates_per_call(self, encoding: bool) -> int:
        """Return the updates of one compiled call: those due after a step of every environment."""
        return max(1, int(self.num_envs * self.update_ratio(encoding)))

    def updates_due(self, steps: int, spec: EnvSpec) -> int:
        """Return how many updates belong to this many environment steps.

        Args:
            steps: Environment steps.
            spec: What the agent sees: of a frozen encoder's features, the updates before it was
                frozen belong to as many steps as their own ratio asks for.
        """
        encoded = self.freeze_encoder_after if spec.image_shape else 0
        before = encoded / self.update_ratio(encoding=True)
        steps_since = max(0, steps - self.random_steps) - before
        return int(encoded + steps_since * self.update_ratio(spec.is_image))
