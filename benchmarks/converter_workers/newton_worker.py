"""Convert a USD file with newton: ``python newton_worker.py IN.usd OUT.xml [resolvers] [floating]``."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

newton = import_module("newton")
options: dict[str, Any] = {}
if "resolvers" in sys.argv[3:]:
    names = ("SchemaResolverMjc", "SchemaResolverPhysx", "SchemaResolverNewton")
    usd = import_module("newton.usd")
    options["schema_resolvers"] = [getattr(usd, name)() for name in names]
if "floating" in sys.argv[3:]:
    options["floating"] = True
builder = newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(builder)  # needed to read MuJoCo actuators
builder.add_usd(sys.argv[1], **options)
newton.solvers.SolverMuJoCo(builder.finalize(device="cpu"), save_to_mjcf=sys.argv[2])
