"""The two stages' losses: reconstruction (stage one) and data-prediction flow matching (stage two)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.autoencoder import draw_identifiers, reconstruction_losses
from surrogate.models.lam_slide.model import LamSlide

# The weight 1 / sigma^2 diverges at the data end; flow times stop just before it.
TAU_MAX = 0.995


def random_rotations(n: int, generator: torch.Generator) -> Tensor:
    """Return `(n, 3, 3)` rotations, uniform over SO(3): normalised Gaussian quaternions."""
    w, x, y, z = F.normalize(torch.randn(n, 4, generator=generator), dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(n, 3, 3)


def autoencoder_loss(
    model: LamSlide, frames_nm: Tensor, elements: Tensor, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Stage one on frames `(b, n_atoms, 3)` nm: eq. 13, 14 and 16 with table weights; identifiers of Algorithm 1."""
    c = model.config.autoencoder
    batch, n_atoms, _ = frames_nm.shape
    x = frames_nm / model.config.position_scale_nm
    identifiers = model.identifiers(n_atoms).expand(batch, -1)
    if c.random_identifiers > 0:
        drawn = draw_identifiers(identifiers.shape[1], c.identifier_pool, batch, generator).to(x.device)
        pick = torch.rand(batch, 1, generator=generator).to(x.device) < c.random_identifiers
        identifiers = torch.where(pick, drawn, identifiers)
    numbers = elements.expand(batch, n_atoms)
    latents = model.autoencoder.encode(x, numbers, identifiers)
    noise = torch.randn(latents.shape, generator=generator).to(x.device)
    decoded = model.autoencoder.decode(latents + c.latent_noise * noise, identifiers, with_types=c.type_weight > 0)
    position, distance = reconstruction_losses(x, decoded.positions)
    loss = c.position_weight * position + c.distance_weight * distance
    terms = {"position": position, "distance": distance}
    if decoded.type_logits is not None:
        terms["type"] = F.cross_entropy(decoded.type_logits.flatten(0, 1), numbers.flatten())
        loss = loss + c.type_weight * terms["type"]
    return loss, {k: v.detach() for k, v in terms.items()}


def draw_flow_times(model: LamSlide, batch: int, generator: torch.Generator) -> Tensor:
    """Return flow times `(batch,)` in [0, TAU_MAX], logit-normal or uniform."""
    c = model.config.approximator
    if c.uniform_tau:
        return torch.rand(batch, generator=generator).clamp(max=TAU_MAX)
    draws = torch.randn(batch, generator=generator) * c.tau_scale + c.tau_location
    return torch.sigmoid(draws).clamp(max=TAU_MAX)


@dataclass(frozen=True, eq=False)
class FlowWindows:
    """A batch of windows of one molecule as stage two sees them: clean `latents (b, T, L, dim)` of `n_atoms` atoms.

    `lag`: see `LamSlide.embedded_lag`. `importance (b,)`: what each window counts (data.rarity); None is one each. With
    the `kind (b,)` of each window it counts in the cross entropy of the kinds alone: the network is told the kind, and
    within a kind draws are plain.
    """

    latents: Tensor
    n_atoms: int
    lag: Tensor | None = None
    importance: Tensor | None = None
    kind: Tensor | None = None


def flow_loss(
    model: LamSlide, windows: FlowWindows, tau: Tensor, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return stage two's loss at flow times `tau (b,)`, and its terms: eq. 9 on the predicted frames (with
    `loss_on_given` on all), plus decoded position and distance.

    With preconditioning the error is divided by c_out^2, so that every flow time asks for the same relative precision;
    without it the weight is one, as in the paper. The decoded terms compare with the decoded clean latents, so that the
    decoder's own error is not charged to the approximator.
    """
    c = model.config.approximator
    latents, importance, kind = windows.latents, windows.importance, windows.kind
    known = latents[:, : c.n_conditioning]
    noise = torch.randn(latents.shape, generator=generator).to(latents.device)
    alpha, sigma, _, _ = (flow.expand(v, latents) for v in flow.coefficients(tau, c.interpolant))
    noisy = alpha * latents + sigma * noise
    first = 0 if c.loss_on_given else c.n_conditioning
    prediction = model.approximator(noisy, tau, known, kind=kind, lag=windows.lag)[:, first:]
    target = latents[:, first:]
    weight = torch.ones_like(tau)
    if c.precondition:
        weight = flow.preconditioning(tau, c.interpolant)[1].square().reciprocal()
    if importance is not None and kind is None:
        weight = weight * importance
    loss = ((prediction - target).square().flatten(1).mean(1) * weight).mean()
    terms = {"flow": loss.detach()}
    if kind is not None:
        each = F.cross_entropy(model.approximator.kind_logits(known), kind, reduction="none")
        odds = each.mean() if importance is None else (each * importance).mean()
        loss, terms["kind"] = loss + odds, odds.detach()
    if c.auxiliary_frames and (c.position_weight or c.distance_weight):
        pick = torch.randint(target.shape[1], (c.auxiliary_frames,), generator=generator)
        scale = model.config.position_scale_nm
        decoded = model.decode(prediction[:, pick], windows.n_atoms) / scale
        with torch.no_grad():
            clean = model.decode(target[:, pick], windows.n_atoms) / scale
        w = weight.reshape(-1, 1, 1, 1).sqrt()
        position = ((decoded - clean) * w).square().sum(-1).mean()
        i, j = torch.triu_indices(windows.n_atoms, windows.n_atoms, 1)
        span = lambda x: ((x[..., i, :] - x[..., j, :]).square().sum(-1) + 1e-12).sqrt()  # noqa: E731
        distance = ((span(decoded) - span(clean)) * w[..., 0]).square().mean()
        loss = loss + c.position_weight * position + c.distance_weight * distance
        terms |= {"position": position.detach(), "distance": distance.detach()}
    return loss, terms
