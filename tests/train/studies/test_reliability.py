"""A few of the hostile inputs of docs/reliability.md, and whether mishandling would be noticed."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from renderer.errors import InputError
from renderer.light.presets import load_light
from renderer.mesh import load_mesh
from train.studies.commands import Ending
from train.studies.reliability.corpus import BESIDE, LIGHTS, MESHES, write_corpus
from train.studies.reliability.damages import damages
from train.studies.reliability.doors import BY_NAME, DOORS
from train.studies.reliability.process import Surroundings, forked, started
from train.studies.reliability.study import Outcome, _keep, _kept, failures, outcome, page
from train.studies.reliability.trials import Trial, all_trials, file_trials, name_trials

LIGHT = BY_NAME["export_light.py"]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "corpus"
    folder.mkdir()
    write_corpus(folder)
    return folder


def trial(refused: bool = False, named: tuple[str, ...] = ("out",)) -> Trial:
    return Trial(LIGHT, "kind", "name", LIGHT.command(), named, refused)


SENTENCE = "error: out=x cannot be written: choose another\n"
ENDINGS = [
    (Ending(0, ""), False, None),
    (Ending(0, ""), True, "taken"),
    (Ending(2, SENTENCE), True, None),
    (Ending(2, "error: something is wrong\n"), True, "neither out is named: error: something is wrong"),
    (Ending(2, SENTENCE + "and more\n"), True, "status 2: error: out=x cannot be written: choose another | and more"),
    (Ending(1, SENTENCE), True, "status 1: error: out=x cannot be written: choose another"),
    (Ending(1, "Traceback\nValueError: x\n"), True, "status 1: Traceback | ValueError: x"),
    (Ending(139, ""), False, "status 139: "),
    (Ending(None, ""), False, "hung"),
]


@pytest.mark.parametrize(("ending", "refused", "fault"), ENDINGS)
def test_only_a_success_or_one_sentence_is_no_fault(ending, refused, fault):
    found = trial(refused).fault(ending)
    assert found == fault or (fault and found.startswith(fault))


def test_every_file_that_a_door_reads_is_in_the_corpus_and_every_edit_changes_it(corpus, tmp_path):
    made_later = ("finished", "published")
    for door in DOORS:
        for file in [file for files in door.inputs.values() for file in files]:
            assert (corpus / file).is_file() or file.startswith(made_later), file
    for number, tried in enumerate(file_trials(LIGHT)):
        for name in LIGHT.inputs["light={}"]:
            folder = tmp_path / str(number)
            folder.mkdir(exist_ok=True)
            (folder / name).write_bytes((corpus / name).read_bytes())
        tried.prepare(folder)
        file = folder / tried.name.partition(":")[0]
        assert not file.is_file() or file.read_bytes() != (corpus / file.name).read_bytes(), tried.name


LOADERS = {**dict.fromkeys(MESHES, load_mesh), **dict.fromkeys(LIGHTS, lambda path: load_light(str(path)))}


@pytest.mark.filterwarnings("ignore")  # of a library, on what it then refuses or reads
@pytest.mark.parametrize("file", [*LOADERS, *BESIDE])
def test_the_library_refuses_each_damage_in_one_sentence_that_names_the_file(corpus, tmp_path, file):
    given = BESIDE.get(file, file)
    for number, damage in enumerate(damages(file)):
        folder = tmp_path / str(number)
        shutil.copytree(corpus, folder, ignore=shutil.ignore_patterns("ph*", "pic*", "*.npz"))
        damage.edit(folder / file)
        try:
            LOADERS[given](folder / given)
        except InputError as error:
            assert given in str(error) and "\n" not in str(error), damage.name
        else:
            assert not damage.refused, damage.name


def test_names_of_trials_tell_them_apart():
    trials = [(tried.kind, tried.name) for tried in all_trials(LIGHT)]
    assert len(trials) > 100 and len(set(trials)) == len(trials)


def test_a_fault_is_counted_listed_and_fails_the_command():
    outcomes = [
        Outcome("attack.py", "forged", "a", 0, None),
        Outcome("attack.py", "forged", "b", 2, None),
        Outcome("attack.py", "forged", "c", None, "hung"),
    ]
    assert failures(outcomes) == ["attack.py: 'c': hung"]
    written = page(outcomes, "python scripts/check_reliability.py", number=6)
    assert "\n| attack.py | 0 | 0 | 3 | 0 | 0 | 0 | 1 | 1 | 1 |\n" in written
    assert written.endswith("\n\n- attack.py: 'c': hung\n") and "hung" not in page(outcomes[:2], "x", 2)


def test_a_run_goes_on_with_the_outcomes_that_it_kept_and_the_last_of_each_counts(tmp_path):
    file, trials = tmp_path / "new" / "outcomes.jsonl", list(name_trials(LIGHT))
    found = [Outcome(each.door.name, each.kind, each.name, 2, "hung", started=True) for each in trials[::2]]
    mended = replace(found[1], fault=None)
    for each in [*found, mended, replace(mended, door="a door that is gone")]:
        _keep(file, each)
    assert _kept(file, trials) == {2 * place: each for place, each in enumerate(found)} | {2: mended}
    for damage in ("x", "[1]", '{"door": 1}'):
        file.write_text(damage)
        with pytest.raises(InputError, match=r"outcomes=.*give a file of this command"):
            _kept(file, trials)


def test_a_network_of_other_classes_may_be_published_and_is_refused_at_every_other_door():
    name = "best.pt: other classes"
    taken = {each.door.name for door in DOORS for each in file_trials(door) if name in each.name and not each.refused}
    asked = {each.door.name for door in DOORS for each in file_trials(door) if name in each.name}
    assert taken == {"publish.py"} and {"attack.py", "evaluate_photos.py", "train data=npz"} <= asked


@pytest.mark.slow
@pytest.mark.parametrize("largest", [200, None])
@pytest.mark.parametrize("light", ["light.npy", "gone.npy"])
def test_a_started_and_a_forked_process_end_alike(corpus, light, largest):
    command, around = LIGHT.command(f"light={light}"), Surroundings(largest)
    assert started(command, corpus, around, 60) == forked(command, corpus, around, 60)


@pytest.mark.slow
def test_a_few_hostile_inputs_at_a_command_are_used_or_refused(corpus):
    outcomes = [outcome(tried, corpus) for tried in list(all_trials(LIGHT))[::20]]
    assert len(outcomes) > 5 and not failures(outcomes)
    assert {each.status for each in outcomes} == {0, 2}
