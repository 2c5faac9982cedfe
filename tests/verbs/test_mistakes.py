"""What a person may get wrong is said in a line, with its place, and nothing is made."""

from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("rn", 'Unknown command "rn". Did you mean "run"?'),
        ("run --bemwidth 3", "Unknown option: --bemwidth. Did you mean --beamwidth?"),
        ("run --rays.powr 3", "Unknown option: --rays.powr. Did you mean --rays.exponent?"),
        ("run --rays.exponent x", '--rays.exponent: unable to convert "x" into float'),
        ("run --rays.exponent nan", "--rays.exponent: found nan, expected a finite number"),
        ("run --rays.exponent", "--rays.exponent requires an argument"),
        ("run --landmarks 2.5", "--landmarks: found '2.5', expected a whole number"),
        ("run --scenario.steps 9.5", "--scenario.steps: found '9.5', expected a whole number"),
        ("run --landmarks -1", "--landmarks: found -1, expected greater than or equal to 0"),
        ("run --seed -1", "--seed: found -1, expected greater than or equal to 0"),
        ("run --filter ukf",
         "found 'ukf', expected one of ekf, fastslam, iekf, smoother, both, all, module:Class"),
        ("run --filter smother", "module:Class; did you mean 'smoother'?"),
        ("run --filter ekf,ikef", "--filter: found 'ikef', expected one of ekf"),
        ("run --filter ekf,", "found '', expected one of ekf"),
        ("run --filter all,ekf",
         "--filter: found 'all' in a list; it stands alone, for ekf, fastslam, iekf"),
        ("study --duration 5", "--duration. Did you mean --scenario.steps?"),
        ("study --beamwidth 5", "--beamwidth. Did you mean --emitter.radius?"),
        ("run --receiver.sample-rate 20", "found 20 Hz, expected a multiple of 5000 Hz"),
        ("config show --receiver.sample-rate 20", "found 20 Hz, expected a multiple of 5000 Hz"),
        ("run walk.wav", "walk.wav: found an audio recording, expected no argument"),
        ("report", "FOLDER requires an argument"),
        ("report --folder one", "Unknown option: --folder"),
        ("run --filter mine.py:Own", "; write mine:Own"),
        ("run --filter ekf --filter.calibrate speed_scale",
         "filter.calibrate: found speed_scale with the filter ekf, which "),
        ("run --filter smoother --filter.calibrate gravity", "speed_scale"),
        ("run --frames 0:2", "--frames"),
        ("run --save-sound tape --frames 8:9 --duration 2", "--frames"),
        ("run --filter fastslam --particles 0", "--particles: found 0, expected greater than or"),
        ("run --filter fastslam --particles 9.5", "--particles: found '9.5', expected a whole"),
        ("run --particles 9", "--particles: found 9, but --filter is smoother, which has no"),
        ("run --filter both --particles 3 --fastslam.particles 3",
         "--particles and --fastslam.particles are one setting; give one of them"),
        ("run --strategy active,loud", "--strategy: found 'loud', expected 'active', 'fused',"),
        ("run --duration 0.4", "--duration: found 0.4, expected at least one frame (0.5 s)"),
        ("run --duration nan", "--duration: found nan, expected at least one frame"),
        ("run --duration inf", "--duration: found inf, expected at least one frame"),
        ("run --duration 1e308", "--duration: found 1e+308, expected at least one frame"),
        ("run --duration 1e30", "--duration 1e+30: found 8000000000000000"),
        ("run --duration 1e12", "8,000,000,000,000 steps may need"),
        ("run --scenario.steps 200000000", "200,000,000 steps may need"),
        ("run --beamwidth 190", "found 190.0 degrees, expected above 0 and up to 180"),
        ("run --beamwidth nan", "found nan degrees, expected above 0 and up to 180"),
        ("run --landmarks 3 --scenario.landmarks 3",
         "--landmarks and --scenario.landmarks are one setting; give one of them"),
        ("run --timing true", "Unknown option: --timing. Did you mean --listening.excess-paths?"),
        ("slam x --robust huber", "Unknown option: --robust. Did you mean --filter.robust?"),
        ("run --assumed 3", "--assumed: is a section of settings; name one of it, as --assumed."),
        ("run --config none.toml", "none.toml: found no such file"),
        ("run --config .", "--settings: found '.', a folder, expected a TOML file of settings"),
        ("run --landmarks 9999", "scenario.landmarks: found 9999"),
        ("run --animate=avi", 'Invalid value "avi" for --animate'),
        ("run --animate avi", "--animate: found 'avi', expected gif or mp4"),
        ("run --animate gif extra", "run: found 'extra', but run takes no arguments"),
        ("run extra", "run: found 'extra', but run takes no arguments"),
        ("slam one two", "slam: found 'two', but slam takes one argument"),
        ("slam one --filter ekf two", "options begin with --, and commas join their values"),
        ("config show extra", "config show: found 'extra', but config show takes no arguments"),
        ("run --scenario.start 0 0", "--scenario.start: found 2 values, expected 3"),
        ("run --scenario.start {a=1}", "--scenario.start: Incorrect number of arguments"),
        ("run --scenario.start -1e308 0 0",
         "--scenario.start: found (-1e+308, 0.0, 0.0), expected"),
        ("run --air.speed-of-sound 5e-324", "--air.speed-of-sound: found 5e-324, expected greater"),
        ("run --motion.wheelbase 1e-300", "--motion.wheelbase: found 1e-300, expected at least 1e"),
        ("run --receiver.spacing 3",
         "receiver.spacing: found 3 m, 306.122 waves; expected at most"),
        ("run --scenario.beacon-distance 1e9", "scenario.beacon_distance: a recording of 1.17e+07"),
        ("run --scenario.radius 1e9", "scenario.radius: a recording of 1.1"),
        ("run --scenario.start 1e9 0 0", "scenario.start: a recording of 1.17e+07 s may need"),
        ("run --emitter.call-duration 1e6", "emitter.call_duration: a recording of 1e+06 s"),
        ("run --scenario.speed 400", "scenario.speed: the vehicle reaches 400 m/s, expected less"),
        ("run --motion.speed-std 400", "motion.speed_std: the vehicle reaches"),
        ("view", "FOLDER requires an argument"),
        ("view none", "none: found no such folder, expected the result folder of"),
        ("view .", ".: found no summary.json"),
        ("view one two", "view: found 'two', but view takes one argument"),
        ("view none --overwrit", "Unknown option: --overwrit. Did you mean --overwrite?"),
        ("slam", "LOG requires an argument"),
        ("slam --animate none", "none: found no such folder"),
        ("slam none -x", "Unknown option: -x."),
        ("slam none -xo", "Unknown option: -x"),
        ("slam none", "none: found no such folder"),
        ("slam . --emitter.level-db 3", "--emitter.level-db: means nothing to a recorded log"),
        ("slam . --filter.range-std 3", "--filter.range-std: the log decides this"),
        ("slam . --gate 2", '--gate: found 2.0, expected above 0 and up to 1, or "auto"'),
        ("slam . --gate 0.9 --filter.gate 0.9", "--gate and --filter.gate are one setting"),
        ("slam . --particles 9", "--particles: found 9, but --filter is smoother, which has"),
        ("slam . --filter both --particles 0", "--particles: found 0, expected greater than or"),
        ("slam . --filter both --particles 3 --fastslam.particles 3",
         "--particles and --fastslam.particles are one setting; give one of them"),
        ("slam . --beamwidth 0", "--beamwidth: found 0, expected above 0 and up to 360"),
        ("slam . --beamwidth nan", "--beamwidth: found nan, expected above 0"),
        ("slam . --robot one",
         "but robot one was asked for, expected a MRCLAM set; leave out --robot"),
    ],
)  # fmt: skip
def test_mistakes_are_explained_in_a_line_and_write_nothing(refused, words, said):
    assert said in refused(*words.split())
    assert [path.name for path in Path().iterdir() if path.name != "runs"] == []
    assert not any(Path().glob("runs/*"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "-o", ""], "-o: found ''"),
        (["run", "--save-log="], "--save-log: found ''"),
        (["slam", ""], "slam: found ''"),
        (["report", "", "-o", "d"], "report: found '', expected a value (for the folder that"),
    ],
)
def test_an_empty_path_is_rejected(refused, words, said):
    assert said in refused(*words)


def test_a_users_list_of_checksums_is_recognised_as_foreign(refused):
    Path("d").mkdir()
    Path("d/SHA256SUMS").write_text(f"{'0' * 64}  notes.txt\n")
    Path("d/notes.txt").touch()
    assert "(its SHA256SUMS is not Pipistrelle's)" in refused("run", "-o", "d")


def test_mistakes_in_a_file_or_the_environment_are_located(refused, monkeypatch):
    Path("mission.toml").write_text("[rays]\npowr = 3\n")
    found = refused("run", "--config", "mission.toml")
    assert found == "mission.toml: rays.powr: no such setting; did you mean rays.exponent?"
    Path("mission.toml").write_text("[rays]\npower 3\n")
    assert ", expected TOML; correct the line" in refused("run", "--config", "mission.toml")
    monkeypatch.setenv("PIPISTRELLE_RAYS__EXPONENT", "0")
    assert refused("run") == "PIPISTRELLE_RAYS__EXPONENT: found 0, expected greater than 0"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = " + "[" * 5000, "found more than 8 levels, expected tables of settings"),
        ("a = " + "[" * 50 + "]" * 50, "a.0.0: found more than 8 levels, expected tables"),
        (".".join("a" * 500) + " = 1", "a.a.a: found more than 8 levels, expected tables"),
        ("seed = " + "1" * 5000, "found an integer of many digits, expected at most 64 bits"),
        ("seed = 0x" + "f" * 5000, "seed: found an integer of 20000 bits, expected at most 64"),
        ("seed = " + '"' + "x" * 5000 + '"', "x..., expected a valid integer"),
    ],
)
def test_a_pathological_file_is_rejected_in_a_line(refused, text, said):
    Path("mission.toml").write_text(text)
    for words in (["run", "--config", "mission.toml"], ["study", "mission.toml"]):
        found = refused(*words)
        assert found.startswith("mission.toml: ")
        assert len(found) < 300
        assert said in found or (words[0] == "study" and "found no keys 'format'" in found)
    assert not Path("runs").exists()


def test_a_film_without_ffmpeg_is_rejected_before_the_mission(refused, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert "found no ffmpeg" in refused("run", "--animate", "mp4")
    assert not Path("runs").exists()
