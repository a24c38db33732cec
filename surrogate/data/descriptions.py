"""Input features of a scene as each model asks for them: made here, because models import no chemistry."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from surrogate.data.features.peptide_chains import chain_features
from surrogate.data.poses import fitted_atoms
from surrogate.models.atom_features import AtomFeatures, features_of_graph
from surrogate.models.interface import Molecule, Surrogate

if TYPE_CHECKING:
    from systems.scene import Scene


def describe(model: Surrogate, scene: Scene) -> Molecule:
    """Return the input features of a scene that this model asks for; the scene is posed as its frames are."""
    molecule = replace(Molecule.of(scene), own=model.features(scene))
    if model.knows_chains:
        return replace(molecule, chain=chain_features(scene, model.config))
    return replace(molecule, atoms=features_of_scene(scene)) if model.knows_bonds else molecule


def features_of_scene(scene: Scene) -> AtomFeatures:
    """Return the features of a scene's covalent graph, and of its positions about the middle of the fitted atoms."""
    from systems.chemistry.graph import ring_bonds
    from systems.chemistry.symmetry import local_handedness

    handedness = np.zeros(scene.n_atoms)
    for centre, sign in local_handedness(scene).items():
        handedness[centre] = sign
    template_nm = scene.positions_nm - scene.positions_nm[fitted_atoms(scene)].mean(axis=0)
    return features_of_graph(
        scene.n_atoms, scene.bonds, scene.bond_orders, ring_bonds(scene), scene.formal_charges, handedness, template_nm
    )
