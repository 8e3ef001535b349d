"""Multilayer perceptrons, distributions, critics, encoder and autoencoders."""
