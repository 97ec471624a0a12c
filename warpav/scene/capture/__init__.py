"""Traffic as cameras record it: what a capture holds, the plan of its cameras, simulators, and files on disk."""
