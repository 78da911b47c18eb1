from pathlib import Path

import torch


class Recurrent(torch.nn.Module):
    """A learned drive that consists of a two-layer LSTM and a linear layer."""

    def __init__(self) -> None:
        super().__init__()
        self.lstm = torch.nn.LSTM(2, 8, 2, batch_first=True)
        self.out = torch.nn.Linear(8, 1)

    def forward(
        self, x: torch.Tensor, memory: tuple[torch.Tensor, torch.Tensor]
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        y, memory = self.lstm(x, memory)
        return self.out(y[:, -1]), memory


def perceptron(inputs: int = 6, outputs: int = 1) -> torch.nn.Sequential:
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(inputs, 16), torch.nn.Softsign(), torch.nn.Linear(16, outputs))


def recurrent() -> Recurrent:
    torch.manual_seed(0)
    return Recurrent()


def written(module: torch.nn.Module, file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    torch.jit.save(torch.jit.script(module), str(file))
    return file


class WritesAFile(torch.nn.Module):
    """A TorchScript module that writes a file."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x[:, :1] + torch.from_file("written_by_a_network", True, 4).sum()


class RunsAtLoading(torch.nn.Module):
    """A TorchScript module that fails while it is loaded."""

    def __init__(self) -> None:
        super().__init__()
        self.number = 1

    @torch.jit.export
    def __getstate__(self) -> tuple[int, bool]:
        return self.number, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[int, bool]) -> None:
        assert state[0] > 1, "ran while it was loaded"
        self.number, self.training = state

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x


class Endless(torch.nn.Module):
    """A TorchScript module that never returns."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        while bool(x.sum() < 1):
            x = x * 1.0
        return x[:, :1]


class Growing(torch.nn.Module):
    """A TorchScript module that needs 24 GB."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = x.repeat(1000000, 1000)
        return x[:, :1] + y.sum()


class Repeating(torch.nn.Module):
    """A perceptron with 10,000,000,000 weights that all are the same stored number."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1, 1).expand(100_000, 100_000))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x[:, :1] * self.weight[0, 0]


def doubling(file: Path, times: int) -> Path:
    """Write a network in which each method calls the one before it twice: 2^times operations when it is inlined."""
    file.parent.mkdir(parents=True)
    module = torch.jit.script(torch.nn.Module())
    module.define("def f0(self, x):\n    return x[:, :1]\n")
    for number in range(1, times + 1):
        module.define(f"def f{number}(self, x):\n    return self.f{number - 1}(x) + self.f{number - 1}(x)\n")
    module.define(f"def forward(self, x):\n    return self.f{times}(x)\n")
    torch.jit.save(module, str(file))
    return file
