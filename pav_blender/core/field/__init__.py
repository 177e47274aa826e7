"""The canonical radiance field: encoding, appearance embeddings, three networks, the avatar."""
