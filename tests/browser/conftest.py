from collections.abc import Iterator

import pytest
from jobs.small import cache_of, copied, trained_once, wheelleg

from browser.chrome import Chrome, programs
from wheelleg_exp.run.run_directory import RunDirectory


@pytest.fixture(scope="module")
def chrome(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    try:
        browser, driver = programs()
    except FileNotFoundError as error:
        pytest.skip(str(error))
    with Chrome(browser, driver, tmp_path_factory.mktemp("chrome")) as running:
        yield running


@pytest.fixture(scope="session")
def played(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    run = copied(trained_once(tmp_path_factory), tmp_path_factory.mktemp("browser"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        said = wheelleg("play", run.path, "env.num_envs=4", "env.episode_length_s=1")
    assert said.status == 0, said.err
    return run
