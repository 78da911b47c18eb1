"""The report of ``check --physics``: facts about the robot, the value of each reward, and findings of lint rules."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace

from wheelleg_exp.anatomy.compiled_robot import RobotFacts, compiled_robot
from wheelleg_exp.asset.conversion_cache import REPORT
from wheelleg_exp.asset.conversion_report import Report
from wheelleg_exp.config.checking.check_robot_names import converted
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.config.schema import PHYSICS_RULES, Experiment

# Importing the modules ``rules_*`` registers the lint rules.
from wheelleg_exp.lint import rules_drives, rules_episode, rules_interface, rules_learning, rules_links, rules_shape  # noqa: F401
from wheelleg_exp.lint.reward_tolerances import contributions, earned_per_second
from wheelleg_exp.lint.rule import RULES as _RULES
from wheelleg_exp.lint.rule import Case, Finding, Rule
from wheelleg_exp.managers import SceneManager
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.terms.config_sections import read_section

RULES: dict[str, Rule] = {name: _RULES[name] for name in PHYSICS_RULES}


@dataclass(frozen=True)
class PhysicsReport:
    """The findings of ``wheelleg check --physics`` for one config, and the config's reasons to silence lint rules.

    ``levels`` contains the level of each key's source: 0 is a stock file, 1 a file of the user, 2 an override. A
    silence applies to values of its own level and of lower levels.
    """

    case: Case
    findings: tuple[Finding, ...]
    reasons: Mapping[str, str]
    levels: Mapping[str, int]

    @property
    def open(self) -> list[Finding]:
        """The findings that the config does not silence in ``check.silence``."""
        return [finding for finding in self.findings if not self.silences(finding)]

    @property
    def silenced(self) -> list[Finding]:
        """The findings that the config silences in ``check.silence``."""
        return [finding for finding in self.findings if self.silences(finding)]

    def silences(self, finding: Finding) -> bool:
        """Return whether the config silences a finding."""
        level = max(self.levels.get(f"{section}.silence.{finding.rule}", 0) for section in ("check", "env.robot"))
        found = (at for key, at in self.levels.items() if key == finding.key or key.startswith(f"{finding.key}."))
        return finding.rule in self.reasons and level >= max(found, default=0)

    @property
    def unused(self) -> list[str]:
        """The lint rules in ``check.silence`` that report no finding, so that silencing them has no effect."""
        found = {finding.rule for finding in self.findings}
        return [name for name in self.reasons if name not in found and name not in self.case.env.robot.silence]

    def rewards_table(self) -> list[tuple[str, str, str, str, str, str]]:
        """Return each reward: name, weight, tolerance, per step, per episode, share of a perfect robot's reward."""
        found, rows = contributions(self.case), []
        best = earned_per_second(found) * self.case.episode_s
        for item in found:
            episode, step = item.per_episode(self.case), item.per_step(self.case.step_dt)
            share = f"{100 * episode / best:.3g} %" if best > 0 else ""
            known = (item.tolerance, f"{step:.2g}", f"{episode:.3g}", share)
            rows.append(
                (item.term.name, f"{item.weight:g}", *(known if item.value is not None else ("not known", "", "", "")))
            )
        return rows

    def document(self) -> dict[str, object]:
        rewards = [
            {
                "term": item.term.path,
                "weight": item.weight,
                "tolerance": item.tolerance or None,
                "value": item.value,
                "per_step": None if item.value is None else item.per_step(self.case.step_dt),
                "per_episode": None if item.value is None else item.per_episode(self.case),
            }
            for item in contributions(self.case)
        ]
        return {
            "findings": [asdict(finding) for finding in self.open],
            "silenced": [{**asdict(finding), "reason": self.reasons[finding.rule]} for finding in self.silenced],
            "unused_silences": self.unused,
            "facts": asdict(self.case.facts),
            "rewards": rewards,
        }


def examine(composed: Composed) -> PhysicsReport:
    """Compile and measure the robot of a config, and run every lint rule. The config must have no errors."""
    with composed.placing():
        config = read_section(Experiment, composed.config, "")
        mjcf = converted(composed.config["env"], composed.asset_roots)
        # No step is simulated, so MuJoCo on the CPU is enough, even if the config sets another engine.
        sim = replace(config.env.sim, engine="mujoco", device="cpu")
        scene = SceneManager(replace(config.env, sim=sim), mjcf, num_envs=1).scene
        report = None
        with suppress(OSError, ValueError):
            report = Report.from_json(mjcf.with_name(REPORT).read_text(encoding="utf-8"))
        robot, facts = compiled_robot(scene.spec.compile(), scene.robot, report)
        case = Case(config, facts, robot)
    found = [finding for rule in RULES.values() for finding in rule(case)]
    placed = [replace(finding, where=composed.provenance.where(finding.key)) for finding in found]
    silences = [config.env.robot.silence, config.check.silence if config.check is not None else {}]
    reasons = {name: why for given in silences for name, why in given.items() if why is not None}
    stock = configs_dir()
    levels = {
        key: int(not source.file.is_relative_to(stock)) if source.file is not None else 2
        for key, source in composed.provenance.items()
        if source.value is not None or ".silence." not in key
    }
    return PhysicsReport(case, tuple(placed), reasons, levels)


def facts_rows(facts: RobotFacts) -> list[tuple[str, str, str]]:
    """Return facts about a robot as rows of text: name, value, unit."""
    rows = [
        ("mass", f"{facts.mass:.4g}", "kg"),
        ("weight on each wheel", f"{facts.wheel_load:.3g}", "N"),
        ("wheels", ", ".join(facts.wheels) or "none", ""),
        ("wheel radius", f"{1e3 * facts.wheel_radius:.4g}", "mm"),
        ("track", f"{1e3 * facts.track:.4g}", "mm"),
        ("standing height", f"{1e3 * facts.standing_height:.4g}", "mm"),
        ("start above the ground", f"{round(1e3 * facts.clearance, 3) + 0.0:g}", "mm"),
        ("friction before randomisation", f"{facts.friction:.3g}", ""),
        ("slips at", f"{facts.friction * facts.wheel_load * facts.wheel_radius:.3g}", "N·m"),
        ("top speed", f"{facts.top_speed:.3g}", "m/s"),
    ]
    if facts.balance is not None:
        rows += [
            ("mass on the axle", f"{facts.balance.mass:.4g}", "kg"),
            ("its height over the axle", f"{1e3 * facts.balance.height:.4g}", "mm"),
            ("its inertia about the axle", f"{facts.balance.inertia:.3g}", "kg·m²"),
            ("falls in (time constant)", f"{1 / facts.balance.pole:.3g}", "s"),
        ]
    return rows
