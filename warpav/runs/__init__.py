"""Jobs from a configuration: objects, run folder, report, progress."""
