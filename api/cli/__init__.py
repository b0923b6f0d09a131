"""The command line: `lazy_commands` lists the commands, `commands` has a module for each, the others do their work."""
