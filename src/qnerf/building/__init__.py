"""From a configuration to a scene and a model: `components`, `scene`, `model`, in this order."""
