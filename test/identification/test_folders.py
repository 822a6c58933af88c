# SPDX-License-Identifier: Apache-2.0
"""A folder stands for the recordings in it; the parts of a split bag are one recording."""

import os
from pathlib import Path
import shutil

from needle_identification import RecordingError
from needle_identification.bags.bag import Bag, METADATA
from needle_identification.recordings.folders import recordings_in
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from support.samples import EPOCH, STORE, TEXT, text

ROS1 = get_typestore(Stores.ROS1_NOETIC)
LENGTH = 4.5  # of a data file [s]
SUFFIXES = ('.mcap', '.mcap.zstd', '.db3', '.bag')


def data_file(path: Path, start: float = 0.0) -> Path:
    """Write ten messages, two in a second, in the format of the suffix, without metadata."""
    path.parent.mkdir(exist_ok=True)
    times = [EPOCH + round(1e9 * (start + LENGTH * k / 9)) for k in range(10)]
    if path.suffix == '.bag':
        with Ros1Writer(path) as old:
            connection = old.add_connection('/a', TEXT, typestore=ROS1)
            data = bytes(ROS1.serialize_ros1(ROS1.types[TEXT]('x'), TEXT))
            for time in times:
                old.write(connection, time, data)
        return path
    own = path.with_name('own')
    plugin = StoragePlugin.SQLITE3 if '.db3' in path.suffixes else StoragePlugin.MCAP
    writer = Writer(own, version=9, storage_plugin=plugin)
    if path.suffix == '.zstd':
        writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection('/a', TEXT, typestore=STORE)
        for time in times:
            writer.write(connection, time, text('x'))
    (file,) = (one for one in own.iterdir() if one.name != 'metadata.yaml')
    file.rename(path)
    shutil.rmtree(own)
    return path


def test_a_folder_stands_for_the_recordings_in_it(tmp_path: Path) -> None:
    """Tables, and bags whether they were closed or not; a bag stands for itself."""
    for name in (
        'b.csv',
        'a.MAT',
        'notes.md',
        'one/metadata.yaml',
        'two/two_0.mcap',
        'three/x.md',
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = [tmp_path / name for name in ('a.MAT', 'b.csv', 'one', 'two')]
    assert recordings_in(tmp_path) == found
    for other in (tmp_path / 'two', tmp_path / 'three', tmp_path / 'b.csv', tmp_path / 'none'):
        assert recordings_in(other) == [other]
    (tmp_path / 'x.mcap').touch()
    assert recordings_in(tmp_path) == [*found, tmp_path / 'x.mcap']


def test_links_to_folders_above_are_not_followed(tmp_path: Path) -> None:
    """Two links in a folder to itself make as many paths as the system permits."""
    made = data_file(tmp_path / 'runs' / 'one.mcap')
    other = data_file(tmp_path / 'other' / 'two.mcap')
    for name in 'abc':
        (made.parent / name).symlink_to('.')
    (made.parent / 'there').symlink_to(other.parent)
    (other.parent / 'back').symlink_to(made.parent)
    assert {one.resolve() for one in recordings_in(made.parent)} == {made, other.parent}


def test_metadata_that_is_a_pipe_is_not_read(tmp_path: Path) -> None:
    made = data_file(tmp_path / 'bag' / 'one.mcap')
    os.mkfifo(made.parent / METADATA)
    assert any(f'no readable {METADATA}' in loss for loss in Bag(made.parent).losses)


@pytest.mark.parametrize('names', [('gel.mcap', 'liver.mcap'), ('run.db3', 'run.mcap')])
def test_data_files_of_other_names_or_formats_are_recordings(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    """Also in a folder in the folder."""
    files = [data_file(tmp_path / 'day' / name) for name in names]
    assert recordings_in(tmp_path / 'day') == files
    assert recordings_in(tmp_path) == files


@pytest.mark.parametrize('suffix', SUFFIXES)
@pytest.mark.parametrize(('gap', 'joined'), [(0.5, True), (60.0, False), (-LENGTH, False)])
def test_parts_are_one_recording_if_their_times_continue(
    tmp_path: Path, suffix: str, gap: float, joined: bool
) -> None:
    """Without metadata, which names the parts."""
    folder = tmp_path / 'runs'
    files = [data_file(folder / f'run_{k}{suffix}', k * (LENGTH + gap)) for k in (9, 10)]
    assert recordings_in(folder) == ([folder] if joined else sorted(files))
    if joined:
        bag = Bag(folder)
        assert sum(1 for _ in bag.messages(lambda _: True)) == 20
        data_file(folder / f'other{suffix}')
        with pytest.raises(RecordingError, match=r'run_9.* to run_10.*move these parts to a'):
            recordings_in(folder)
    else:
        with pytest.raises(RecordingError, match='several recordings; name them, such as'):
            Bag(folder)


@pytest.mark.parametrize('suffix', ['.mcap', '.db3', '.bag'])
def test_a_crashed_recording_is_one_recording(tmp_path: Path, suffix: str) -> None:
    """The last part of a split one is cut off, or empty."""
    folder = tmp_path / 'runs'
    last = data_file(folder / f'run_1{suffix}', LENGTH + 0.1)
    last.write_bytes(last.read_bytes()[: last.stat().st_size // 2])
    assert recordings_in(folder) == [folder]
    data_file(folder / f'run_0{suffix}')
    assert recordings_in(folder) == [folder]
    last.write_bytes(b'')
    assert recordings_in(folder) == [folder]


def test_missing_parts_of_a_recording_are_named(tmp_path: Path) -> None:
    """By the metadata, or by the numbers of the parts without metadata."""
    for number in (0, 2, 5):
        start = LENGTH * [0, 2, 5].index(number)
        data_file(tmp_path / 'split' / f'run_{number}.mcap', start)
    (tmp_path / 'split' / 'metadata.yaml').unlink(missing_ok=True)
    assert Bag(tmp_path / 'split').losses[1:] == ['run_1 is missing', 'run_3 to run_4 are missing']
    (tmp_path / 'gone').mkdir()
    (tmp_path / 'gone' / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: {relative_file_paths: [a_0.mcap]}', encoding='utf-8'
    )
    with pytest.raises(RecordingError, match=r'gone holds no recording: a_0\.mcap is missing'):
        Bag(tmp_path / 'gone')
