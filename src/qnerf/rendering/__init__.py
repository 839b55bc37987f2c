"""Where rays are sampled, and how samples become colours."""
