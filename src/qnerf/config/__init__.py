"""What a run is told: settings, their checks, components by name, and what makes two runs the same."""
