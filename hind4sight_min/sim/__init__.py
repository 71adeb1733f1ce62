"""The poke simulator: what lies in the arena, the arena in Bullet, collection, and the truth that only it knows."""
