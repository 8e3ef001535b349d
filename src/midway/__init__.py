"""Goal-conditioned reinforcement learning with imagined subgoals."""
