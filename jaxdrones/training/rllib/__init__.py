"""Training by RLlib's new API stack: the paper's multi-agent workflow. Needs ray."""
