"""Pictures and films of bodies, shapes, and camera sensors, which MuJoCo draws in a child process."""
