"""Robot anatomy: which parts are wheels and legs, the stance, and measured facts. Found by geometry, never by a name.

| module | what it offers |
|---|---|
| `anatomy_parts` | wheels, legs, and mirrored joints as data; the body tree of a compiled model |
| `limbs` | find wheels, legs, and mirrored joints |
| `robot_anatomy` | `anatomy_of`, the anatomy of a compiled model |
| `collider_shapes` | extent of colliders, and bodies that overlap |
| `compiled_robot` | model, pose, anatomy, and measured facts of a robot |
| `stance` | the pose in which a robot stands and balances |
"""
