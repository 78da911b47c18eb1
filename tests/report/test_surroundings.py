from report.runs import change_manifest, make_run

THREADS = {
    **{"torch": 2, "interop": 1, "physics": 2, "cpu_capability": "AVX2", "device": "cpu", "variables_in_time": True},
    "mkl": {"branch": "avx2", "strict": True},
    "numerics": {"libraries": ["oneDNN v3.7"], "mkldnn": True, "default_dtype": "float32", "keeps_denormals": True},
    "independent": True,
    "dependent_because": [],
}


def test_threads_and_arithmetic_are_described_in_words(page, root):
    run = make_run(root)
    change_manifest(run, threads=THREADS)
    text = page(run).section("source")
    for fact in ("Threads of torch 2", "MKL's code branch avx2, strict", "Numbers depend on torch's threads no"):
        assert fact in text
    for fact in ("oneDNN in use yes", "Library oneDNN v3.7"):
        assert fact in text
    for raw in ("{", "[]", "variables_in_time", "Dependent because"):
        assert raw not in text
    change_manifest(run, threads={**THREADS, "independent": False, "dependent_because": ["MKL is not strict"]})
    assert "Numbers depend on torch's threads MKL is not strict" in page(run).section("source")
