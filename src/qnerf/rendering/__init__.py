"""Where rays are sampled, and how samples become colours."""

from qnerf.rendering import proposal_sampler  # registers sampler=proposal

__all__ = ["proposal_sampler"]
