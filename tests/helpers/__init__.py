"""What several tests share: configurations, scenes, stores."""
