"""Native goal environments on batched MuJoCo, and the registry of all environments."""
