"""Chooses among the variants of a stage before it is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pxr import Usd

from wheelleg_exp.errors import AssetError, nearest_name


def choose(usd: Usd.Stage, variants: Mapping[str, str]) -> dict[str, str]:
    """Choose variants on the stage's session layer, and return the names in force by variant set.

    Args:
        usd: an open stage.
        variants: names by variant set; sets are looked for on the default prim first, then below it.

    Raises:
        AssetError: there is no such set, or it has no such name.
    """
    root = usd.GetDefaultPrim() or usd.GetPseudoRoot()
    usd.SetEditTarget(usd.GetSessionLayer())
    chosen = {}
    for name, wanted in variants.items():
        holders = [prim for prim in Usd.PrimRange(root) if name in prim.GetVariantSets().GetNames()]
        if not holders:
            known = list(variant_sets(root))
            raise AssetError(
                f"there is no variant set '{name}'",
                key=f"--variant {name}={wanted}",
                expected="one of " + ", ".join(known) if known else "no variants: the file has none",
                nearest=nearest_name(name, known),
            )
        options = holders[0].GetVariantSet(name).GetVariantNames()
        if wanted not in options:
            raise AssetError(
                f"variant set '{name}' has no '{wanted}'",
                key=f"--variant {name}={wanted}",
                expected="one of " + ", ".join(options),
                nearest=nearest_name(wanted, options),
            )
        holders[0].GetVariantSet(name).SetVariantSelection(wanted)
        chosen[name] = wanted
    sets = root.GetVariantSets()
    return {**chosen, **{name: sets.GetVariantSelection(name) for name in sorted(sets.GetNames())}}


def unselected(root: Usd.Prim) -> Iterator[str]:
    """Yield a warning for each variant set without a selection: nothing of any of its variants is read."""
    for name, options in variant_sets(root).items():
        holder = next(prim for prim in Usd.PrimRange(root) if name in prim.GetVariantSets().GetNames())
        if options and not holder.GetVariantSet(name).GetVariantSelection():
            hint = f"--variant {name}=NAME takes one of {', '.join(options)}"
            yield f"{holder.GetPath()}: no variant of '{name}' is selected; {hint}"


def variant_sets(root: Usd.Prim) -> dict[str, list[str]]:
    """Return the names to choose from, by variant set: those of ``root`` first, then those below it."""
    found: dict[str, list[str]] = {}
    for prim in Usd.PrimRange(root):
        for name in prim.GetVariantSets().GetNames():
            found.setdefault(name, list(prim.GetVariantSet(name).GetVariantNames()))
    return found
