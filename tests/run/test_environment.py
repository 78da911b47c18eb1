import json
import os
import subprocess
import sys
from importlib import metadata
from types import SimpleNamespace

import pytest
from packaging.requirements import Requirement

import wheelleg_exp
from wheelleg_exp import machine
from wheelleg_exp.run import environment

CPUINFO = """processor\t: 0
vendor_id\t: AuthenticAMD
cpu family\t: 26
model\t\t: 2
model name\t: AMD EPYC
stepping\t: 1
flags\t\t: fpu sse2 fma avx avx2 avx512_bf16 rdrand

processor\t: 1
model name\t: another
"""


def test_every_distribution_stands_with_its_version_sorted():
    lines = environment.distributions()
    found = {Requirement(line.split("  #")[0]).name: line for line in lines}
    assert f"mujoco-core=={metadata.version('mujoco-core')}" in lines
    for distribution in metadata.distributions():
        assert distribution.metadata["Name"] in found
    names = [name.lower().replace("_", "-").replace(".", "-") for name in found]
    assert names == sorted(names)


def test_local_versions_and_origins_are_stored_and_the_first_installation_counts(tmp_path, monkeypatch):
    origin = {"url": "https://me:pw@host.org/a.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}}
    for name, version, source in (("zz_demo", "1.0+cpu", origin), ("NumPy", "0.0.1", None)):
        folder = tmp_path / f"{name}-{version}.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        if source:
            (folder / "direct_url.json").write_text(json.dumps(source))
    monkeypatch.syspath_prepend(str(tmp_path))
    lines = environment.distributions()
    assert "zz_demo==1.0+cpu  # https://host.org/a.git abc" in lines
    assert [line for line in lines if line.lower().startswith("numpy==")] == ["NumPy==0.0.1"]


def test_the_text_is_the_same_twice_and_reads_as_requirements():
    text = environment.environment_text({"torch": 2})
    assert text == environment.environment_text({"torch": 2})
    assert "#   torch: 2\n" in text
    for line in text.splitlines():
        if not line.startswith("#"):
            Requirement(line.split("  #")[0])


def test_variables_that_change_numbers_or_that_a_config_requests_are_stored_unless_they_look_secret():
    environ = {"MKL_CBWR": "AVX2", "OMP_NUM_THREADS": "1", "ATEN_CPU_CAPABILITY": "avx2", "PYTHONHASHSEED": "0"}
    other = {"HOME": "/x", "AWS_SECRET_ACCESS_KEY": "k", "WHEELLEG_TOKEN": "t", "MY_OMP_X": "1"}
    assert environment.variables({**environ, **other}) == dict(sorted(environ.items()))
    texts = ["a: ${oc.env:SPEED}\nb: ${oc.env:MY_TOKEN,x}\n", "c: '${ oc.env: SPEED, 3 } ${oc.decode:${oc.env:MASS}}'"]
    requested = environment.requested_variables(texts)
    assert requested == ["MASS", "MY_TOKEN", "SPEED"]
    values = {"SPEED": "3", "MY_TOKEN": "t", "OTHER": "x", "OMP_X": "1"}
    assert environment.variables(values, also=requested) == {"SPEED": "3", "OMP_X": "1"}


@pytest.mark.parametrize(
    "name",
    [
        *("MKL_NUM_THREADS", "OMP_WAIT_POLICY", "KMP_AFFINITY", "GOMP_CPU_AFFINITY", "OPENBLAS_CORETYPE"),
        *("NPY_DISABLE_CPU_FEATURES", "GLIBC_TUNABLES", "ONEDNN_MAX_CPU_ISA", "ATEN_CPU_CAPABILITY", "TORCH_LOGS"),
        *("CUDA_VISIBLE_DEVICES", "CUBLAS_WORKSPACE_CONFIG", "NVIDIA_TF32_OVERRIDE", "HSA_OVERRIDE_GFX_VERSION"),
        *("MUJOCO_PLUGIN_PATH", "PXR_PLUGINPATH_NAME", "WHEELLEG_CACHE", "LD_PRELOAD", "LD_LIBRARY_PATH"),
        *("PYTHONPATH", "PYTHONHASHSEED", "PYTHONOPTIMIZE", "PYTHONWARNINGS", "PYTHON_GIL", "LC_NUMERIC", "LANG"),
    ],
)
def test_a_variable_that_can_change_a_result_shows(name):
    assert environment.variables({name: "a"}) != environment.variables({name: "b"})


@pytest.mark.parametrize("key", ["cores_usable", "cpu", "cpu_flags", "torch_cpu_capability"])
def test_another_processor_or_container_shows(key, tmp_path, monkeypatch):
    before = environment.hardware()
    (tmp_path / "cpuinfo").write_text(CPUINFO.replace("AMD EPYC", "Another").replace("avx512_bf16", "amx_tile"))
    backends = SimpleNamespace(cpu=SimpleNamespace(get_cpu_capability=lambda: "ANOTHER"))
    monkeypatch.setattr(machine, "_CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(environment, "usable_cores", lambda: 1000)
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(backends=backends))
    assert environment.hardware().get(key) != before.get(key)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such file")
def test_the_cpu_is_read_from_the_first_block(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_CPUINFO", tmp_path / "cpuinfo")
    before = environment.hardware()
    assert not {"cpu_family", "cpu_flags"} & before.keys()
    assert before["cores"] == os.cpu_count()
    json.dumps(before)
    (tmp_path / "cpuinfo").write_text(CPUINFO)
    facts = {"cpu": "AMD EPYC", "cpu_family": "26", "cpu_model": "2", "cpu_stepping": "1"}
    facts["cpu_flags"] = ["avx", "avx2", "avx512_bf16", "fma"]
    assert environment.hardware().items() >= facts.items()


def test_the_program_has_the_version_of_its_code_and_an_absent_distribution_none(monkeypatch):
    monkeypatch.setattr(environment, "_DISTRIBUTIONS", ("no-such-thing",))
    monkeypatch.setattr(wheelleg_exp, "__version__", "7.0.0")  # An editable installation names an older version.
    found = environment.versions()
    assert (found["no-such-thing"], found["wheelleg_exp"]) == (None, "7.0.0")


def test_the_part_loads_neither_torch_nor_mujoco():
    code = "import sys, wheelleg_exp.run.start_run, wheelleg_exp.run.run_list, wheelleg_exp.run.source_restore\n"
    code += "print([m for m in ('torch', 'mujoco', 'hydra') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
