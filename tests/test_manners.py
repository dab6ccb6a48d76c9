"""What commands never do: lose a file, hide what happened, or go on after an interrupt."""

import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
from contextlib import contextmanager
from pathlib import Path

import click
import numpy as np
import pytest
from matplotlib.figure import Figure

import gs_jax as gs
from gs_jax.__main__ import COMMANDS, commands, interrupt_message
from gs_jax.base.machine import keep_programs
from gs_jax.cli import options
from gs_jax.cli.commands import RESUMABLE
from gs_jax.cli.reconstruct import deconvolve_command
from gs_jax.detection.unet import pretrained, write_weights
from gs_jax.io.files import atomic_write, write_figure, write_json, write_text
from gs_jax.mold.export import Mask, Mesh, write_mask, write_mesh
from gs_jax.mold.heights import HEIGHT_SUFFIXES, write_heights
from gs_jax.optics.psf import PSFS
from gs_jax.projection.forward_model import FIDELITIES
from gs_jax.reconstruction.deconvolution import SOLVERS
from gs_jax.reconstruction.pipeline import METHODS
from gs_jax.simulation import OPTICS

from .test_cli import RECONSTRUCT

ROOT = Path(__file__).parents[1]


def test_names_are_those_of_the_library():
    assert options.METHODS == tuple(METHODS) and options.FIDELITIES == FIDELITIES
    (method,) = (option for option in deconvolve_command.params if option.name == "method")
    assert isinstance(method.type, click.Choice) and tuple(method.type.choices) == (*SOLVERS, "wiener")
    assert options.SIMULATED == OPTICS and options.PSFS == tuple(PSFS)


def test_help_imports_nothing_heavy():
    names = ["", *COMMANDS]
    code = (
        "import sys\nfrom gs_jax.__main__ import main\n"
        f"for name in {names!r}:\n"
        "    sys.argv = ['gs-jax', *name.split(), '--help']\n"
        "    try:\n        main()\n"
        "    except SystemExit as end:\n        assert not end.code, name\n"
        "    heavy = {'jax', 'equinox', 'scipy', 'skimage', 'matplotlib', 'zarr'} & set(sys.modules)\n"
        "    assert not heavy, (name, heavy)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage: gs-jax") == len(names)
    context = click.Context(commands)
    for name in COMMANDS:
        command = commands.get_command(context, name)
        assert command and command.help and command.get_short_help_str(200).endswith(".")
        assert all(param.help for param in command.params if isinstance(param, click.Option)), name


def test_without_arguments_it_shows_its_help(run):
    status, out, _ = run()
    assert status == 0 and out.startswith("Usage: gs-jax") and "reconstruct" in out


@pytest.mark.integration
def test_reconstruct_by_default_needs_no_scipy(folder):
    """Its imports took as long as the back-projection of a full sensor."""
    code = (
        f"import sys; sys.argv = ['gs-jax', *{RECONSTRUCT!r}, '-o', 'volume.ome.tif']\n"
        "from gs_jax.__main__ import main\n"
        "try:\n    main()\n"
        "finally:\n    assert not {'scipy', 'skimage', 'matplotlib', 'zarr', 'optax', 'numba'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr


def test_an_output_that_is_an_input_is_refused(folder, run):
    os.link(folder / "capture.tif", folder / "linked.tif")
    (folder / "pointer.tif").symlink_to("capture.tif")
    for arguments in (
        (*RECONSTRUCT, "-o", "capture.tif"),
        (*RECONSTRUCT, "-o", f"../{folder.name}/capture.tif"),
        (*RECONSTRUCT, "-o", "linked.tif"),
        (*RECONSTRUCT, "-o", "pointer.tif"),
        (*RECONSTRUCT, "--dark", "dark.tif", "-o", "dark.tif"),
        ("simulate", "scene.ome.tif", "design.toml", "-o", "scene.ome.tif"),
        ("optimize", "design.toml", "--study", "study.toml", "-o", "design.toml"),
        ("optimize", "design.toml", "--study", "study.toml", "-o", "study.toml"),
    ):
        for name in ("scene.ome.tif", "study.toml", "dark.tif"):
            (folder / name).touch()
        before = {path: path.read_bytes() for path in folder.iterdir()}
        status, _, err = run(*arguments)
        assert status == 2 and "the output must be another file than the inputs" in err, arguments
        assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_what_people_write_is_replaced_by_force_alone(folder, run):
    layout = ("layout", "--count", 200, "--size-mm", 20, 20, "--pitch-mm", 1.23, "-o", "c.csv")
    (folder / "c.csv").write_text("mine")
    status, _, err = run(*layout)
    assert status == 2 and "c.csv: the output must be a new file" in err and "--force" in err
    assert (folder / "c.csv").read_text() == "mine"
    status, _, err = run(*layout, "--force")
    assert status == 0 and "replaced c.csv" in err and "x_mm" in (folder / "c.csv").read_text()
    # Results need no force.
    (folder / "v.tif").write_text("old")
    status, _, err = run(*RECONSTRUCT, "-o", "v.tif")
    assert status == 0 and err.strip() == "gs-jax: replaced v.tif"


@pytest.fixture(scope="module")
def small_disk(tmp_path_factory):
    """A file system with room for 4 KiB."""
    place = tmp_path_factory.mktemp("disk")
    try:
        mount = ["mount", "-t", "tmpfs", "-o", "size=4k", "tmpfs", place]
        subprocess.run(mount, check=True, capture_output=True, timeout=10)
    except (OSError, subprocess.SubprocessError) as error:
        pytest.skip(f"no file system can be mounted: {error}")
    yield place
    subprocess.run(["umount", place], check=True)


NOISE = np.random.default_rng(0).random((2, 99, 99), np.float32)
GRID = gs.Grid([18.0, 20.0], NOISE.shape[1:], 0.1)
MESH = Mesh(NOISE.reshape(-1, 3)[:999], np.arange(999).reshape(-1, 3))
CIRCLES = np.column_stack([np.arange(999), np.zeros(999), np.full(999, 0.5)])
MASK = Mask(np.array([[-1.0, -1.0], [999.0, -1.0], [999.0, 1.0], [-1.0, 1.0]]), CIRCLES, [], [])


def _picture(path):
    figure = Figure()
    figure.subplots().imshow(NOISE[0])
    write_figure(path, figure)


WRITERS = {
    "v.ome.tif": lambda path: gs.write_volume(path, NOISE, GRID),
    "v.zarr": lambda path: gs.write_volume(path, NOISE, GRID),
    "c.tif": lambda path: gs.write_capture(path, NOISE[0]),
    "c.png": lambda path: gs.write_capture(path, NOISE[0].view(np.uint16)),
    "c.npy": lambda path: gs.write_capture(path, NOISE[0]),
    "p.csv": lambda path: gs.write_points(path, 1 + NOISE.reshape(-1, 6)[:, :4]),
    "d.toml": lambda path: gs.write_design(path, gs.read_design(ROOT / "design" / "geomscope.toml")),
    "w.npz": lambda path: write_weights(path, pretrained("paper")),
    "f.png": _picture,
    "r.html": lambda path: write_text(path, 9999 * "r", [".html"]),
    "r.json": lambda path: write_json(path, NOISE),
    "m.stl": lambda path: write_mesh(path, MESH, "m"),
    "m.3mf": lambda path: write_mesh(path, MESH, "m"),
    "m.dxf": lambda path: write_mask(path, MASK),
    "m.svg": lambda path: write_mask(path, MASK),
    "m.gds": lambda path: pytest.importorskip("gdstk") and write_mask(path, MASK),
    **{
        f"h{suffix}": lambda path: write_heights(ROOT / "design" / "geomscope.toml", path) for suffix in HEIGHT_SUFFIXES
    },
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line_and_status_1(small_disk, run, monkeypatch, name):
    path = small_disk / name
    monkeypatch.setattr(commands, "main", lambda **_: WRITERS[name](path))
    status, _, err = run()
    assert status == 1 and err.startswith(f"gs-jax: {path}: ") and err.count("\n") == 1
    assert list(small_disk.iterdir()) == []


@pytest.mark.integration
def test_a_command_on_a_full_disk_leaves_nothing(small_disk, folder, run):
    path = small_disk / "v.ome.tif"
    status, _, err = run(*RECONSTRUCT, "-o", path)
    assert status == 1 and err.startswith(f"gs-jax: {path}: ") and err.count("\n") == 1
    assert list(small_disk.iterdir()) == []


def test_resume_without_a_checkpoint_says_that(folder, run):
    (folder / "study.toml").touch()
    optimize = ("optimize", "design.toml", "--study", "study.toml", "-o", "new.toml")
    for arguments in (optimize, ("train", "-o", "w.npz")):
        status, _, err = run(*arguments, "--resume")
        assert status == 2 and "--resume must be used after an interrupted run" in err and "study" not in err


def test_programs_are_kept_unless_the_user_says_where(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "mine")
    keep_programs()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "mine" and not list(tmp_path.iterdir())
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    keep_programs()
    folder = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    old, new = folder / "old-cache", folder / "new-cache"
    old.touch()
    new.touch()
    os.utime(old, (0, 0))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    keep_programs()
    assert list(folder.iterdir()) == [new] and folder.is_relative_to(tmp_path)
    # Without a folder that can be made, programs are not kept.
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(new))
    keep_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_an_interrupt_says_what_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("gs_jax.__main__.partial_outputs", {tmp_path / "w.checkpoint": RESUMABLE})
    assert interrupt_message() == "gs-jax: interrupted"
    (tmp_path / "w.checkpoint").touch()
    assert interrupt_message().endswith("w.checkpoint has what is done, and --resume goes on from it")


# A job that a shell starts in the background ignores Ctrl-C, and so would its children.
HEARD = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"


# A call that never returns to Python, as compiled code may for minutes, while a file is being written.
BUSY = f"""
{HEARD}
import ctypes, gs_jax.__main__ as cli
from gs_jax.design.design import read_design, write_design
from gs_jax.io.captures import read_capture, write_capture
from gs_jax.io.files import atomic_write, write_json, write_text
from gs_jax.io.files import write_figure
from gs_jax.io.point_tables import write_points
from gs_jax.io.volumes import write_volume
from gs_jax.mold.export import Mask, write_mask
from gs_jax.mold.export import Mesh, write_mesh
def busy(*_, **__):
    with atomic_write("half.tif") as temporary:
        temporary.write_bytes(b"half")
        print("busy", flush=True)
        mutex = ctypes.create_string_buffer(128)
        for _ in range(2):  # nobody unlocks it
            ctypes.CDLL(None).pthread_mutex_lock(mutex)
cli.commands.main = busy
cli.script()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="its zeros are an open mutex")
@pytest.mark.parametrize("number, status", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_compiled_code_and_leaves_nothing(tmp_path, number, status):
    with _started(BUSY, cwd=tmp_path) as process:
        assert process.stdout and process.stdout.readline() == "busy\n"
        process.send_signal(number)
        _, err = process.communicate(timeout=20)
    assert process.returncode == status and err.strip() == "gs-jax: interrupted"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_interrupts_at_any_moment(folder):
    """Between the first import and the last byte."""
    rng = np.random.default_rng(0)
    code = f"{HEARD}; from gs_jax.__main__ import script; script()"
    options = ("-o", "v.tif", "--method", "richardson-lucy", "--steps", "200")
    before = set(folder.iterdir())
    for wait in rng.uniform(0.3, 6, 20):
        with _started(code, *RECONSTRUCT, *options) as process:
            time.sleep(wait)
            sent = time.monotonic()
            process.send_signal(signal.SIGINT)
            _, err = process.communicate()
        took = time.monotonic() - sent
        assert process.returncode in (130, 0), (wait, process.returncode, err)
        assert took < 4 and "Traceback" not in err
        assert set(folder.iterdir()) - before <= {folder / "v.tif"}
        Path("v.tif").unlink(missing_ok=True)


@contextmanager
def _started(code, *arguments, cwd=None):
    """A process of Python, that does not outlive the test."""
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=cwd, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_what_is_being_written_is_removed_with_the_process(tmp_path):
    from gs_jax.io.files import remove_temporaries

    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "a.json") as temporary:
        temporary.write_text("{")
        remove_temporaries()
    assert list(tmp_path.iterdir()) == []


IMPORTING = f"""
{HEARD}
from gs_jax.__main__ import exit_on_signal
with exit_on_signal():
    try:
        import slow_extension
    except BaseException as error:
        print("seen", error)
"""


def test_an_interrupt_within_an_import_is_no_exception(tmp_path):
    """It would be raised in the middle of an extension's initialisation, which may crash."""
    (tmp_path / "slow_extension.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nx = 1\n")
    done = subprocess.run([sys.executable, "-c", IMPORTING], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "gs-jax: interrupted\n")


def test_a_folder_that_threads_still_write_to_is_removed(tmp_path):
    """As Zarr's do for a moment after an interrupt."""

    def write(folder):
        for number in range(20):
            folder.mkdir(exist_ok=True)
            (folder / str(number)).touch()
            time.sleep(0.01)

    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "a.zarr") as temporary:
        threading.Thread(target=write, args=(temporary,)).start()
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


@pytest.mark.integration
def test_a_design_is_found_by_its_name(folder, run, monkeypatch):
    monkeypatch.chdir(folder)
    assert {path.stem for path in options.shipped_designs()} >= {"geomscope", "geomscope-optimized", "endoscope"}
    status, out, _ = run("metrics", "endoscope")
    assert status == 0 and out.startswith("endoscope: ")
    status, _, err = run("metrics", "endoskop")
    assert status == 2 and "endoskop: cannot be read" in err
    status, out, _ = run("info", "--designs")
    assert status == 0 and {line.split()[0] for line in out.splitlines()} == {p.stem for p in options.shipped_designs()}


def test_the_wheel_has_every_design():
    """What a checkout finds in its folder, an installed package finds inside."""
    inside = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert sorted(inside["force-include"]) == sorted(f"design/{path.name}" for path in options.shipped_designs())


@pytest.mark.integration
def test_the_camera_of_simulate_is_free(folder, run, monkeypatch):
    options = "--optics near --bits 8 --gain 20 --offset 7 --read-noise 0 --full-well 900".split()
    (folder / "scene.csv").write_text("x_mm,y_mm,z_mm,intensity\n0.1,0.1,20,1\n")
    monkeypatch.chdir(folder)
    status, _, err = run("simulate", "scene.csv", "design.toml", *options, "-o", "c8.tif")
    assert status == 0, err
    counts = gs.read_capture(folder / "c8.tif")
    # 900 electrons of 20 a count, on an offset of 7.
    assert counts.dtype == np.uint8 and counts.min() == 7 and counts.max() == 52


@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("zarr", "zarr", (*RECONSTRUCT, "-o", "out.zarr")),
        ("jinja2", "report", ("report", "design.toml", "-o", "out.html")),
        ("ezdxf", "mold", ("mask", "design.toml", "-o", "out.dxf")),
        ("lxml", "mold", ("mold", "design.toml", "-o", "out.3mf")),
    ],
)
def test_a_missing_extra_is_named_and_nothing_is_written(module, extra, arguments, folder, run, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == module]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, module, None)
    status, _, err = run(*arguments)
    assert status == 2 and err.endswith(f"gs-jax[{extra}]'.\n") and err.count("\n") == 1
    assert not list(Path().glob("out.*"))
