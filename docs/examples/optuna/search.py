"""Search for values of a task's keys with Optuna: weak trials stop early, and the other trials resume exactly."""

import argparse
import json
import subprocess
import sys

import optuna
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override

DONE = (optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED, optuna.trial.TrialState.FAIL)


def wheelleg(*words: str) -> dict:
    """Run a command of wheelleg, and return its JSON document."""
    done = subprocess.run([sys.executable, "-m", "wheelleg_exp", *words, "--json"], stdout=subprocess.PIPE, text=True)
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode:  # The search continues with the next trial.
        raise RuntimeError(f"exit status {done.returncode}: wheelleg {' '.join(words)}")
    return json.loads(done.stdout)


def suggest(trial: optuna.Trial, override: Override) -> str:
    """Return an override with a single value; Optuna selects the value if the override is a sweep."""
    key, value = override.get_key_element(), override.value()
    if isinstance(value, IntervalSweep):
        kind = trial.suggest_int if isinstance(value.start, int) else trial.suggest_float
        return f"{key}={kind(key, value.start, value.end, log='log' in value.tags)}"
    if override.is_sweep_override():
        return f"{key}={trial.suggest_categorical(key, list(override.sweep_iterator()))}"
    return str(override.input_line)


def main() -> None:
    """Run the trials that are missing in the study's file, and print the best trial."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="+", help="of `wheelleg train`; KEY=interval(A,B), choice(A,B), range(A,B)")
    parser.add_argument("--trials", type=int, default=24)
    parser.add_argument("--iterations", type=int, default=[10, 30, 90], nargs="+", help="in total; equal factors")
    parser.add_argument("--figure", default="Train/mean_episode_length", help="one of the results of a run")
    parser.add_argument("--direction", default="maximize", choices=("maximize", "minimize"))
    parser.add_argument("--study", default="search.log", help="several processes with the same file share the trials")
    args = parser.parse_args()
    overrides = OverridesParser.create().parse_overrides(args.overrides)
    first, *later = args.iterations

    def objective(trial: optuna.Trial) -> float:
        words = ["train", *(suggest(trial, override) for override in overrides)]
        for total in args.iterations:
            trained = wheelleg(*words, f"agent.max_iterations={total}")
            words, value = ["resume", trained["run"]], float(trained["results"][args.figure])
            trial.set_user_attr("run", trained["run"])
            trial.report(value, total)
            if total < args.iterations[-1] and trial.should_prune():
                raise optuna.TrialPruned
        return value

    listed = not any(isinstance(override.value(), IntervalSweep) for override in overrides)
    study = optuna.create_study(
        study_name="search",
        load_if_exists=True,
        direction=args.direction,
        storage=optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(args.study)),
        sampler=optuna.samplers.BruteForceSampler(seed=1) if listed else optuna.samplers.TPESampler(seed=1),
        pruner=optuna.pruners.SuccessiveHalvingPruner(first, later[0] // first if later else 2),
    )
    enough = optuna.study.MaxTrialsCallback(args.trials, states=DONE)
    study.optimize(objective, callbacks=[enough], catch=RuntimeError)
    iterations = sum(max(trial.intermediate_values, default=0) for trial in study.trials)
    best = study.best_trial
    result = {"run": best.user_attrs["run"], "params": best.params, "value": best.value, "iterations": iterations}
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
