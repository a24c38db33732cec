"""States by the C++ program and by torch; frames so far apart that states alone tell of the next ones."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from surrogate.models.architecture import weights_path
from surrogate.models.peptides import model as model_module
from surrogate.models.peptides import state_jumps
from surrogate.models.peptides.chains import MOST_STATES, mended
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.state_jumps import StateJumps
from surrogate.models.weights import load_weights
from surrogate.sampling.domain import under_conditions
from systems.prepare.peptide import build_peptide

_PLACES = torch.tensor([[2, 0, 3], [3, 2, 2], [2, 3, 3], [3, 2, 1]])
_COUNTS = torch.tensor([[0, 2, 0, 0, 0, 0, 0], [2, 2, 3, 0, 0, 0, 0], [2, 2, 0, 0, 0, 0, 0], [2, 2, 0, 3, 0, 0, 0]])


def _lively(*, coupled: bool) -> StateJumps:
    """Probabilities that depend on all that they may."""
    torch.manual_seed(0)
    net = StateJumps(6, 4, coupled=coupled).requires_grad_(False)
    for parameter in net.parameters():
        parameter.add_(0.1 * torch.randn_like(parameter))
    net.beside_change.mul_(0.1)
    net.logits.bias.add_(4.5)
    return net


def _given(rows: int) -> torch.Tensor:
    found = torch.randint(MOST_STATES, (rows, *_COUNTS.shape), generator=torch.Generator().manual_seed(1))
    return found.minimum((_COUNTS - 1).clamp(min=0))


def _by_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_jumps, "_program", lambda: None)


@pytest.mark.parametrize("coupled", [True, False])
@pytest.mark.parametrize("size", [1.0, 1e4])
def test_the_program_draws_what_torch_draws(monkeypatch: pytest.MonkeyPatch, coupled: bool, size: float) -> None:
    if state_jumps._program() is None:
        pytest.skip("no C++ compiler")
    net, generator, rows = _lively(coupled=coupled), torch.Generator().manual_seed(2), 9
    observed = size * torch.randn(rows, 4, 6, generator=generator)
    ahead = torch.arange(1.0, 13.0)
    times = torch.stack([x * ahead for x in torch.linspace(1.0, 80.0, rows)])
    apart = times[:, :1].expand_as(times)
    uniform = torch.rand(rows, 12, *_COUNTS.shape, generator=generator)
    given = _given(rows), _PLACES, _COUNTS, times, apart, uniform
    far = torch.full_like(times, 1000.0)
    calls = (observed, *given), (None, *given[:3], far, far, uniform)
    ours = [net.draw(*call) for call in calls]
    _by_torch(monkeypatch)
    theirs = [net.draw(*call) for call in calls]
    for x, y in zip(ours, theirs, strict=True):
        # A number may lie between two roundings of a probability, and what follows in that row differs.
        assert (x == y).flatten(1).all(1).sum() >= rows - 1
        assert (x[:, 1:] != x[:, :-1]).any() and not x[..., _COUNTS == 0].any()


@pytest.mark.parametrize("by_torch", [True, False])
def test_of_frames_far_apart_each_follows_from_the_states_before_alone(
    monkeypatch: pytest.MonkeyPatch, by_torch: bool
) -> None:
    """From the second frame on a chunk goes on as one that begins there; chunks of frames near each other do not."""
    if by_torch:
        _by_torch(monkeypatch)
    net, uniform = _lively(coupled=True), torch.rand(6, 8, *_COUNTS.shape, generator=torch.Generator().manual_seed(2))
    time = torch.full((6, 8), 1000.0)
    for observed, same in ((None, True), (torch.zeros(6, 4, 6), False)):
        whole = net.draw(observed, _given(6), _PLACES, _COUNTS, time, time, uniform)
        rest = net.draw(observed, whole[:, 2], _PLACES, _COUNTS, time[:, 3:], time[:, 3:], uniform[:, 3:])
        assert torch.equal(whole[:, 3:], rest) == same


@pytest.mark.parametrize("by_torch", [True, False])
def test_states_of_residues_two_apart_are_drawn_together(monkeypatch: pytest.MonkeyPatch, by_torch: bool) -> None:
    """Also the first to be drawn; weights from before have them independent."""
    if by_torch:
        _by_torch(monkeypatch)
    net, rows, psi = _lively(coupled=True), 4000, 1
    counts = _COUNTS[[1, 1, 1]]
    net.of_new_two_before.weight.copy_(60.0 * net.of_new_beside[0].weight)
    state = {name: x for name, x in net.state_dict().items() if "two_before" not in name}
    before = StateJumps(6, 4, coupled=True).requires_grad_(False)
    before.load_state_dict(state)
    generator = torch.Generator().manual_seed(2)
    uniform, time = torch.rand(rows, 1, *counts.shape, generator=generator), torch.full((rows, 1), 10.0)
    given = torch.zeros(rows, 3, 6), torch.zeros(rows, *counts.shape, dtype=torch.long), _PLACES[:3], counts, time, time
    together, apart = (of.draw(*given, uniform)[:, 0, [0, 2], psi].float() for of in (net, before))
    assert abs(float(torch.corrcoef(together.T)[0, 1])) > 0.3
    assert abs(float(torch.corrcoef(apart.T)[0, 1])) < 0.05


def _shipped(solvent: str) -> PeptideSlide:
    weights = load_weights(weights_path("peptides"))
    model = under_conditions(weights, {"solvent": solvent}).model.at_lag(1000.0)
    assert isinstance(model, PeptideSlide)
    return model


def test_of_frames_far_apart_only_the_crowded_one_and_what_follows_is_drawn_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A frame of the second row is said to overlap until its states are drawn again: these and all after it change."""
    model, scene, at = _shipped("obc2"), build_peptide("ACE-ALA-NME"), 5
    molecule, last = model.featurise(scene), torch.tensor(scene.positions_nm).float().expand(2, 1, -1, -1)
    noise = torch.randn(2, *model.noise_shape(molecule.n_atoms), generator=torch.Generator().manual_seed(3))
    plain = model.next_chunk(last, molecule, noise, solver_steps=2)
    sizes: list[int] = []

    def resolved(tokens: torch.Tensor, states: torch.Tensor, *rest: Any) -> tuple[torch.Tensor, ...]:
        frames, astray, crowded = mended(tokens, states, *rest)
        sizes.append(len(frames))
        if len(sizes) <= 1 + model_module._OVERLAPS:
            crowded[model.n_new + at if len(sizes) == 1 else 0] = True
        return frames, astray & False, crowded

    monkeypatch.setattr(model_module, "mended", resolved)
    chunk = model.next_chunk(last, molecule, noise, solver_steps=2)
    assert sizes == [2 * model.n_new, 1, 1, model.n_new - at]
    same = (chunk.frames_nm == plain.frames_nm).flatten(2).all(-1)
    assert same[0].all() and same[1, :at].all() and not same[1, at:].any()
    assert chunk.evaluations == pytest.approx(2 * sum(sizes) / sizes[0])


def test_frames_far_apart_keep_populations_in_the_first_solvent_alone() -> None:
    lags_ps = 20.0, 100.0, 101.0, 500.0, 501.0, 1000.0
    kept = {solvent: [x for x in lags_ps if _shipped(solvent).keeps_populations(x)] for solvent in ("obc2", "tip3p")}
    assert kept == {"obc2": [20.0, 100.0, 501.0, 1000.0], "tip3p": [20.0]}
