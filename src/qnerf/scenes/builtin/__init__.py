"""The built-in scene: a room with a framed poster, ray traced here."""
