"""The configuration: options and their checks, components by name, ids of runs, and names that older versions used."""
