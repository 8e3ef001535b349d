"""What a run is, apart from its agent."""

from dataclasses import dataclass, field
from fractions import Fraction

from midway.types import ConfigurationError, RelabelMix

MAY_BE_ZERO = ("random_steps", "encoder_batch_size")


@dataclass(frozen=True)
class TrainConfig:
    """Settings of the training loop.

    Attributes:
        steps: Environment steps, over all parallel environments.
        num_envs: Parallel environments K.
        random_steps: Environment steps with uniform random actions, before the first update.
        updates_per_step: Updates for each environment step after the random ones; kept exactly.
        batch_size: Transitions in the batch of one update.
        encoder_batch_size: The same as long as updates encode images; 0 for ``batch_size``.
        replay_capacity: Rows of the replay; an episode of T steps takes T + 2.
        relabel: Shares of own, random and future goals.
        evaluate_every: Environment steps between evaluations.
        evaluation_episodes: Episodes for each task and kind of action.
        log_every: Environment steps between rows of ``metrics.csv``.
        checkpoint_every: Environment steps between checkpoints.
        devices: Accelerators that the batch and the replay are split over.
        task: Task of the environment whose starts and goals are trained on.
    """

    steps: int = 1_000_000
    num_envs: int = 1
    random_steps: int = 10_000
    updates_per_step: float = 1.0
    batch_size: int = 2048
    encoder_batch_size: int = 0
    replay_capacity: int = 1_000_000
    relabel: RelabelMix = field(default_factory=RelabelMix)
    evaluate_every: int = 10_000
    evaluation_episodes: int = 20
    log_every: int = 1_000
    checkpoint_every: int = 50_000
    devices: int = 1
    task: str = "uniform"

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigurationError: A number is not positive, or rows cannot be divided over devices.
        """
        for name, value in vars(self).items():
            if name not in (*MAY_BE_ZERO, "relabel", "task") and value <= 0:
                raise ConfigurationError(f"{name} {value}: must be positive")
        if self.encoder_batch_size < 0:
            raise ConfigurationError(
                f"encoder_batch_size {self.encoder_batch_size}: must not be below 0"
            )
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
        """Updates that one compiled call scans over: those due after a step of every copy."""
        return max(1, int(self.num_envs * self.update_ratio))

    def updates_due(self, steps: int) -> int:
        """Return how many updates belong to this many environment steps."""
        return int(max(0, steps - self.random_steps) * self.update_ratio)
