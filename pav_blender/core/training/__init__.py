"""From a collection to an avatar."""
