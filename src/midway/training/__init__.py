"""The loop: collect, update, evaluate, log, checkpoint."""
