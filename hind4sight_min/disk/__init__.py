"""What is on disk: files written whole or not at all, shards of pokes, checkpoints. The core opens no file."""
