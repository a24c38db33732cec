"""LaM-SLidE's settings as frozen dataclasses, readable from TOML; unknown keys are refused with a suggestion."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from surrogate.models.lam_slide.kinds import Kind
from surrogate.models.settings import build
from systems.errors import InputError


@dataclass(frozen=True)
class AutoencoderConfig:
    """Stage one (Tables 8 to 12; small sizes). `latent_noise` is the standard deviation added to latents in training:
    with LayerNorm bounding their power it makes the encoder spend latent variance where positions need it."""

    n_latents: int = 4
    latent_dim: int = 24
    width: int = 128
    n_heads: int = 4
    head_dim: int = 32
    identifier_dim: int = 64
    identifier_pool: int = 32
    n_octaves: int = 4
    n_encoder_layers: int = 1
    n_decoder_layers: int = 2
    latent_noise: float = 0.03
    position_weight: float = 1.0
    distance_weight: float = 1.0
    type_weight: float = 0.01
    # Share of stage-one samples whose identifiers are drawn at random (Algorithm 1; 1.0 is the paper). The others get
    # the canonical assignment, which is what stage two and rollouts use; one molecule learns it faster.
    random_identifiers: float = 0.0


@dataclass(frozen=True)
class ApproximatorConfig:
    """Stage two. `interpolant` 'linear' or 'gvp' (eq. 7, 8). `precondition` scales skip and output of the data
    prediction by the flow time so that its error vanishes with the noise (Karras 2022, for this path)."""

    chunk_frames: int = 32
    n_conditioning: int = 1
    # Latent vectors joined into one token of the transformer: 1 as in the paper, more for fewer and wider tokens.
    latents_per_token: int = 4
    width: int = 256
    n_layers: int = 7
    n_heads: int = 4
    interpolant: str = "linear"
    precondition: bool = True
    # Conditioning frames see neither the flow time nor the frames that follow them, so that a chunk's evaluations
    # compute them once; False is the paper.
    clean_conditioning: bool = False
    # Given frames count in the loss beside the predicted ones, as in the paper's code.
    loss_on_given: bool = False
    # Flow times are logit-normal: a positive location draws more of them near the data end. Uniform is the paper.
    uniform_tau: bool = False
    tau_location: float = 0.5
    tau_scale: float = 1.4
    position_weight: float = 0.25
    distance_weight: float = 0.25
    auxiliary_frames: int = 4
    # Shortest and longest spacing of frames, in ps: the network is told which it is asked for. None: one spacing alone.
    lag_range_ps: tuple[float, float] | None = None
    # Kinds of rare windows that the network is told of and a head gives the odds of (data.rarity).
    rare_kinds: tuple[Kind, ...] = ()

    def __post_init__(self) -> None:
        if self.loss_on_given and self.clean_conditioning:
            raise InputError("approximator.loss_on_given: with clean_conditioning given frames come back as they are.")

    @property
    def n_kinds(self) -> int:
        return len(self.rare_kinds)


# Settings that weights of earlier versions carry and that no model has any more, whole and of each stage.
_RETIRED = {"": ("graph", "atoms", "hydrogens", "entities", "hydrogen_plan", "residues"),
            "autoencoder": ("frame_weight", "torsion_weight"), "approximator": ("frame_weight",)}  # fmt: skip


@dataclass(frozen=True)
class LamSlideConfig:
    """The whole model. `canonical`: frames are superposed on the template by heavy atoms (exact SE(3) equivariance);
    without it, training rotates at random instead (the paper's augmentation)."""

    canonical: bool = True
    position_scale_nm: float = 0.2
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    approximator: ApproximatorConfig = field(default_factory=ApproximatorConfig)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(record: dict[str, Any]) -> LamSlideConfig:
        """Raises InputError for an unknown key, naming the nearest."""
        return build(LamSlideConfig, record)


def of_weights(record: dict[str, Any]) -> LamSlideConfig:
    """Return the configuration that a weights file carries, without what earlier versions kept there and did not use.
    Raises InputError where it used it."""
    if record.get("graph") or record.get("hydrogen_plan") or record.get("residues"):
        raise InputError("these weights know atoms by their bonds, or place hydrogens; this version does neither.")
    kept = {k: v for k, v in record.items() if k not in _RETIRED[""]}
    for stage in ("autoencoder", "approximator"):
        if isinstance(kept.get(stage), dict):
            kept[stage] = {k: v for k, v in kept[stage].items() if k not in _RETIRED[stage]}
    return LamSlideConfig.from_dict(kept)
