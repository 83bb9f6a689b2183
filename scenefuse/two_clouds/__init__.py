"""Two clouds on their own, without the workflow: one registered in the other, both fused, and a page about it."""
