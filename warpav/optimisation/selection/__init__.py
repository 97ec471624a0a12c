"""The rig out of a pool of single cameras: `select` finds it, and proves how far from the best it is at most."""
