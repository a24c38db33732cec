"""A campaign's file: every run spelled out, seeds by identity, everything unknown refused with what was meant."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from md_reference.campaign.campaign_file import Campaign, first_seed, read_campaign
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.simulate import MDConfig
from systems.errors import InputError

SMALL = 'scenes = ["alanine-dipeptide"]\ntime = "10ps"\n'


def _read(folder: Path, text: str) -> Campaign:
    path = folder / "c.toml"
    path.write_text(text)
    return read_campaign(path)


def test_runs_are_scenes_times_temperatures_times_replicas(tmp_path: Path, repository: Path) -> None:
    (tmp_path / "pdb").mkdir()
    pdb = (repository / "systems" / "library" / "data" / "alanine-dipeptide.pdb").read_bytes()
    for name in ("b", "a"):
        (tmp_path / "pdb" / f"{name}.pdb").write_bytes(pdb)
    campaign = _read(
        tmp_path,
        """
        seed = 5
        temperatures = ["300K", 350]
        replicas = 2
        time = "1ns"
        save_every = "500fs"
        timestep = "2fs"
        friction = "5/ps"
        equilibrate = "20ps"
        platform = "Reference"
        solvent = "vacuum"
        hydrogen_mass = "natural"
        constrain_hydrogens = false
        retries = 0
        ph = 6.5

        [[scenes]]
        scene = "alanine-dipeptide"

        [[scenes]]
        scene = "pdb/*.pdb"
        temperature = "400K"
        replicas = 1
        time = "2ns"
        ph = 4

        [[scenes]]
        scene = "sequence:ACE-GLY-NME"
        name = "gly"
        temperatures = ["290K"]
        """,
    )
    assert [run.name for run in campaign.runs] == [
        "alanine-dipeptide_300K_r0",
        "alanine-dipeptide_300K_r1",
        "alanine-dipeptide_350K_r0",
        "alanine-dipeptide_350K_r1",
        "a_400K_r0",
        "b_400K_r0",
        "gly_290K_r0",
        "gly_290K_r1",
    ]
    first = campaign.runs[0].config
    assert first == MDConfig(
        time_ps=1000.0,
        save_every_ps=0.5,
        keep="solute",
        temperature_k=300.0,
        friction_per_ps=5.0,
        timestep_ps=0.002,
        equilibrate_ps=20.0,
        seed=first_seed(5, "alanine-dipeptide", 300.0),
        platform="Reference",
        force=ForceFieldSpec(
            force_field=first.force.force_field, solvent="vacuum", hydrogen_mass_da=None, constrain_hydrogens=False
        ),
    )
    assert campaign.runs[4].config.time_ps == 2000.0
    assert campaign.runs[6].file == "gly/290K/gly_290K_r0.h5"
    assert campaign.retries == 0
    assert [scene.preparation["ph"] for scene in campaign.scenes] == [6.5, 4, 4, 6.5]
    assert campaign.scenes[1].source == str(tmp_path / "pdb" / "a.pdb")
    assert len(campaign.scenes[1].source_sha256) == 64
    assert campaign.folder == tmp_path / "c"


def test_seeds_depend_on_what_a_run_is_alone(tmp_path: Path) -> None:
    small = {run.name: run.config.seed for run in _read(tmp_path, SMALL + "replicas = 2").runs}
    text = 'scenes = ["sequence:ACE-GLY-NME", "alanine-dipeptide"]\ntime = "20ps"\ntemperatures = [310, 300]\n'
    large = {run.name: run.config.seed for run in _read(tmp_path, text + "replicas = 3").runs}
    assert small.items() <= large.items()
    assert len(set(large.values())) == len(large) == 12
    # Pinned: another rule would make another trajectory of every old campaign.
    assert small["alanine-dipeptide_300K_r0"] == 1652005098
    assert small["alanine-dipeptide_300K_r1"] == 1652005099
    other = {run.config.seed for run in _read(tmp_path, SMALL + "replicas = 2\nseed = 1").runs}
    assert not other & set(small.values())
    assert all(0 <= seed < 2**31 for seed in large.values())


def test_names_of_scenes_serve_as_files(tmp_path: Path) -> None:
    text = 'scenes = ["smiles:c1ccccc1", "smiles:C1CCCCC1", "smiles:C/C=C/C", "sequence:ACE-ALA-NME"]\ntime = "10ps"\n'
    names = [scene.name for scene in _read(tmp_path, text).scenes]
    assert names[3] == "ACE-ALA-NME"
    assert len({name.lower() for name in names}) == 4
    assert not any(set(name) & set("/\\:()[]= ") for name in names)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time = '1ns'", "name the scenes"),
        ("scenes = ['alanine-dipeptide']", "time is missing"),
        (SMALL + "temprature = '300K'", "unknown key 'temprature'. Did you mean 'temperature'?"),
        (SMALL + "seeds = 3", "unknown key 'seeds'. Did you mean 'seed'?"),
        (SMALL + "solvnt = 'vacuum'", "Did you mean 'solvent'?"),
        ("time='10ps'\n[[scenes]]\nscene='alanine-dipeptide'\nreplica=3", "Did you mean 'replicas'?"),
        ("scenes = ['alanine-dipeptid']\ntime='10ps'", "Did you mean 'alanine-dipeptide'?"),
        ("scenes = ['none.pdb']\ntime='10ps'", "no such file"),
        ("scenes = ['*.pdb']\ntime='10ps'", "no file matches"),
        ("scenes = ['alanine-dipeptide', 'alanine-dipeptide']\ntime='10ps'", "two scenes are called"),
        ("time='10ps'\n[[scenes]]\nscene='alanine-dipeptide'\nname='a/b'", "it names files"),
        (SMALL + "temperatures = [300, 300.0]", "listed twice"),
        (SMALL + "temperatures = [300]\ntemperature = 310", "not both"),
        (SMALL + "replicas = 0", "replicas = 0 must be"),
        (SMALL + "replicas = true", "replicas = True must be"),
        (SMALL + "timestep = 4", "no unit"),
        (SMALL + "timestep = '3fs'", "alanine-dipeptide.*whole multiple"),
        (SMALL + "platform = 3", "platform = 3 must be a text"),
        (SMALL + "constrain_hydrogens = 'yes'", "constrain_hydrogens = .yes. must be true or false"),
        (SMALL + "solvent = 'obc3'", "unknown solvent"),
        (SMALL + "ph = true", "ph = True must be a finite number"),
        (SMALL + "format = 'trr'", "format = 'trr' must be one of h5, dcd, xtc"),
        (SMALL + "time = ", "is not valid TOML"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said.replace("?", r"\?")) as caught:
        _read(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "c.toml"))
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_campaign(tmp_path / "none.toml")


def test_one_molecule_has_one_default_in_a_campaign_too(tmp_path: Path) -> None:
    text = 'scenes = ["ethanol", "smiles:CCO", "alanine-dipeptide"]\ntime = "1ps"\n'
    named, smiles, peptide = (replace(run.config, seed=0) for run in _read(tmp_path, text).runs)
    assert named == smiles == peptide and named.keep == "solute"
    assert _read(tmp_path, text + 'keep = "all"\n').runs[0].config.keep == "all"
    assert (named.temperature_k, named.timestep_ps, named.force.force_field) == (300.0, 0.004, "auto")


def test_a_campaign_s_protocol_is_outweighed_by_its_settings_and_outweighs_them_in_a_scene(tmp_path: Path) -> None:
    text = 'scenes = ["ethanol", "smiles:CCO"]\ntime = "1ps"\nprotocol = "md17"\n'
    for run in _read(tmp_path, text).runs:
        config = run.config
        assert (config.temperature_k, config.timestep_ps, config.save_every_ps) == (500.0, 0.0005, 0.005)
        assert (config.force.force_field, config.force.hydrogen_mass_da) == ("gaff2", None)
    hot = _read(tmp_path, text + 'temperatures = ["400K"]\nsave_every = "100fs"\n').runs[0].config
    assert (hot.temperature_k, hot.save_every_ps, hot.timestep_ps) == (400.0, 0.1, 0.0005)

    shared = 'time = "1ps"\ntimestep = "2fs"\nfriction = "2/ps"\ntemperatures = ["300K", "400K"]\n'
    scenes = 'scenes = ["smiles:CC", { scene = "smiles:CCO", protocol = "md17", friction = "3/ps" }]\n'
    *others, own = (run.config for run in _read(tmp_path, scenes + shared).runs)
    assert [(c.temperature_k, c.timestep_ps, c.friction_per_ps) for c in others] == [
        (300.0, 0.002, 2.0),
        (400.0, 0.002, 2.0),
    ]
    assert (own.temperature_k, own.timestep_ps, own.friction_per_ps) == (500.0, 0.0005, 3.0)
    own_axis = scenes.replace('"md17"', '"md17", temperatures = ["310K"]')
    assert [run.config.temperature_k for run in _read(tmp_path, own_axis + shared).runs] == [300.0, 400.0, 310.0]


def test_the_bench_s_molecules_run_as_in_md17_at_both_temperatures(tmp_path: Path) -> None:
    from disturbed_campaign import campaign_text

    runs = _read(tmp_path, campaign_text(20.0)).runs
    assert len(runs) == 40
    aspirin = [run.config for run in runs if run.scene == "aspirin"]
    assert [config.temperature_k for config in aspirin] == [300.0, 300.0, 500.0, 500.0]
    assert {(c.friction_per_ps, c.timestep_ps, c.save_every_ps) for c in aspirin} == {(0.1, 0.0005, 0.02)}


def test_the_file_in_the_manual_is_one(tmp_path: Path, repository: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (repository / "docs" / "campaigns.md").read_text(), re.DOTALL)
    (tmp_path / "pdb").mkdir()
    pdb = (repository / "systems" / "library" / "data" / "alanine-dipeptide.pdb").read_bytes()
    (tmp_path / "pdb" / "a.pdb").write_bytes(pdb)
    campaign = _read(tmp_path, "".join(blocks))
    assert [scene.name for scene in campaign.scenes] == ["alanine-dipeptide", "ACE-GLY-NME", "a", "ethanol"]
    assert len(campaign.runs) == 4 * 2 * 4
