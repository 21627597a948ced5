"""RLDS, read and written without TensorFlow: shards, records, features, images, wherever they lie."""
