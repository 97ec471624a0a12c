"""What every package stands on: errors, YAML with line numbers, atomic writes, Warp, executors, frames."""
