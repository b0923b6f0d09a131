"""The command line: `lazy_commands` lists the commands, `commands` has one module for each, the other modules do the work."""
