"""What a simulated world is made of: people, objects, rooms, furniture and their motion. Plain NumPy."""
