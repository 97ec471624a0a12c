"""What every room stands on: errors, YAML with line numbers, atomic writes, Warp, executors, frames."""
