"""A ring of transitions on the learner's device, with hindsight relabelling."""
