"""What the parts of a robot are for, found by geometry and kinematics and never by a name.

| module | what it offers |
|---|---|
| `parts` | the dataclasses: wheels, legs, mirrored joints, the whole |
| `examine` | `anatomy_of`, the whole look at a compiled model |
| `wheels` | which hinges wheels turn on, and why |
| `tree` | bodies and joints of a model at one pose |
| `limbs` | chains from the base to the wheels, closed loops |
| `mirror` | which joints are mirror images |
"""
