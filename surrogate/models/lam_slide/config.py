"""LaM-SLidE's settings as frozen dataclasses, readable from TOML; unknown keys are refused with a suggestion."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from surrogate.models.hydrogens import HydrogenPlan
from surrogate.models.lam_slide.codes.residue_code import ResidueLayout
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
    # For residues as entities alone (Table 12).
    frame_weight: float = 1.0
    torsion_weight: float = 0.1
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
    # For residues as entities alone (Table 12).
    frame_weight: float = 0.25
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


@dataclass(frozen=True)
class GraphConfig:
    """Atoms known by the covalent graph (`LamSlideConfig.graph`). `turn`: training turns each window at random, its
    template with it; else every molecule keeps the pose that its own shape decides (data.poses). `latents`: what codes
    a frame, a 'set' of latent vectors from an autoencoder, as in the paper, or the 'atoms' themselves, one token each:
    slower, but nothing is lost of a molecule that no autoencoder saw. `rigid_hydrogens`: chunks have bonds to hydrogen
    of the template's length; training sets it where the references hold them rigid."""

    width: int = 96
    n_rounds: int = 4
    n_octaves: int = 3
    turn: bool = False
    latents: str = "set"
    rigid_hydrogens: bool = False


@dataclass(frozen=True)
class LamSlideConfig:
    """The whole model. `canonical`: frames are superposed on the template by heavy atoms (exact SE(3) equivariance);
    without it, training rotates at random instead (the paper's augmentation).

    `graph`: atoms are known by their bonds and by where their molecule's template has them, not by identifiers, and
    the network codes how far they are from there: one model for many molecules, and unseen ones.
    """

    canonical: bool = True
    position_scale_nm: float = 0.2
    graph: bool = False
    atoms: GraphConfig = field(default_factory=GraphConfig)
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    approximator: ApproximatorConfig = field(default_factory=ApproximatorConfig)
    # 'modelled' like any atom, or 'placed': the network moves heavy atoms alone, and hydrogens are placed about them as
    # the reference has them (models.hydrogens). Either way rollouts have all atoms.
    hydrogens: str = "modelled"
    # What an identifier stands for and the encoder codes: an 'atom', or a 'residue' of a peptide with its heavy atoms;
    # hydrogens are then placed.
    entities: str = "atom"
    # Where hydrogens and residues are; training finds it.
    hydrogen_plan: HydrogenPlan | None = None
    residues: ResidueLayout | None = None

    def __post_init__(self) -> None:
        for name, value, known in (("hydrogens", self.hydrogens, ("modelled", "placed")),
                                   ("entities", self.entities, ("atom", "residue")),
                                   ("atoms.latents", self.atoms.latents, ("set", "atoms"))):  # fmt: skip
            if value not in known:
                raise InputError(f"{name} = {value!r} is unknown; choose {' or '.join(known)}.")
        if self.graph and not self.canonical:
            raise InputError("graph = true lays frames on each molecule's template; leave canonical = true.")
        if self.graph and self.on_heavy_atoms:
            raise InputError("graph = true knows all atoms of many molecules; hydrogens are placed for one alone.")

    @property
    def latents_are_atoms(self) -> bool:
        """Whether every atom is a latent of its own; only models that know atoms by the graph can have it so."""
        return self.graph and self.atoms.latents == "atoms"

    @property
    def on_heavy_atoms(self) -> bool:
        """Whether the network sees heavy atoms alone."""
        return self.hydrogens == "placed" or self.entities == "residue"

    @staticmethod
    def of_many(record: dict[str, Any]) -> LamSlideConfig:
        """Return the configuration of a model for many molecules: `record` over sizes that suit latents that are atoms,
        or, where it asks for a set of them, over the sizes of one molecule. Raises InputError as `from_dict` does."""
        atoms = {"latents": "atoms", **record.get("atoms", {})}
        sizes = {"chunk_frames": 8, "width": 128, "n_layers": 5, "auxiliary_frames": 2}
        approximator = {**(sizes if atoms["latents"] == "atoms" else {}), **record.get("approximator", {})}
        return LamSlideConfig.from_dict({**record, "graph": True, "atoms": atoms, "approximator": approximator})

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(record: dict[str, Any]) -> LamSlideConfig:
        """Raises InputError for an unknown key, naming the nearest."""
        return build(LamSlideConfig, record)
