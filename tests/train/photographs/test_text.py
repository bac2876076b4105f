from train.photographs.scoring import evaluate_photographs
from train.photographs.text import format_summary


def test_the_terminal_tables_are_complete(story, tmp_path, read_markdown):
    told, *tables = format_summary(evaluate_photographs(*story, "orange", tmp_path)).split("\n\n")
    assert told == "5 images of orange, 5 of other things"
    shares, ranked, classes = (read_markdown(table)[""] for table in tables)
    assert shares == [
        ["", "recall", "top-5", "false alarms"],
        ["overall", "1/5 = 0.200 [0.036, 0.624]", "4/5 = 0.800 [0.376, 0.964]", "2/5 = 0.400 [0.118, 0.769]"],
        ["lab", "1/2 = 0.500 [0.095, 0.905]", "2/2 = 1.000 [0.342, 1.000]", "-"],
        ["shop", "-", "-", "1/2 = 0.500 [0.095, 0.905]"],
        ["street", "0/2 = 0.000 [0.000, 0.658]", "1/2 = 0.500 [0.095, 0.905]", "1/2 = 0.500 [0.095, 0.905]"],
    ]
    never, unsure = "0.000 [0.000, 0.200]", "0.000 [0.000, 1.000]"
    assert ranked == [
        ["", "AUC", "recall at 5% false alarms", "recall at 10% false alarms", "recall at 20% false alarms"],
        ["overall", "0.340 [0.060, 0.680]", never, never, "0.000 [0.000, 0.400]"],
        ["lab", *"----"],
        ["shop", *"----"],
        ["street", "0.250 [0.000, 1.000]", unsure, unsure, unsure],
    ]
    assert classes == [
        ["class", "n", "recall", "top-5", "called orange", "most common wrong answers"],
        ["orange", "5", "0.200", "0.800", "0.200", "pear 2, apple 1, plum 1"],
        ["other_lemon", "2", "-", "-", "0.500", "lime 1, orange 1"],
        ["pear", "3", "0.333", "0.667", "0.333", "apple 1, orange 1"],
    ]


def test_files_that_were_left_out_are_counted_and_named(story, tmp_path):
    _, _, folder = story
    for number in range(12):
        (folder / "orange" / f"{number:02d}.HEIC").touch()
    summary = evaluate_photographs(*story, "orange", tmp_path / "out")
    assert summary["n"]["left_out"] == 12 and summary["left_out"][:2] == ["orange/00.HEIC", "orange/01.HEIC"]
    last = format_summary(summary).splitlines()[-1]
    assert last.startswith("12 left out, of kinds that are not read: orange/00.HEIC, ") and last.endswith(
        "09.HEIC, ..."
    )
