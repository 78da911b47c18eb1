"""The physics engine ``physx``: NVIDIA PhysX moves the robots of a USD scene on the CPU, and MuJoCo mirrors them."""
