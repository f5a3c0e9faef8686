//! Recordings as files: all written messages are read, cut files are repaired, and damaged files are errors.

#[path = "../../../deploy/fuzz/replay.rs"]
mod fuzz_replay;
#[path = "../../../deploy/fuzz/recordings/target.rs"]
mod fuzz_target;
mod synthetic;

use std::path::Path;

use modalcast_recording::{Error, Recording, Result, Topic, recover};
use synthetic::{RATE, begin, q_at, recording, state, write};

/// One second in nanoseconds.
const SECOND: u64 = 1_000_000_000;

/// Opcode of chunk records.
const CHUNK: u8 = 6;

/// The step numbers of all states from `from` (nanoseconds) on. Fails if a state has other values than
/// `synthetic::state`.
fn step_numbers(recording: &Recording, from: u64) -> Result<Vec<u64>> {
    let mut states = recording.states(from, u64::MAX)?;
    let mut numbers = Vec::new();
    while let Some(recorded) = states.next()? {
        let number = recorded.state.step.number;
        assert_eq!(recorded.state.q(0), Some(&q_at(number)[..]), "step {number}");
        assert_eq!(recorded.state.q(1), Some(&[0.5, -0.5][..]), "step {number}");
        // The translation is the number of the last step with a transform. One step in seven has a transform.
        let transform_step = (0..=number).rev().find(|step| step % 7 == 3).unwrap_or(0);
        assert_eq!(recorded.state.transform(0).expect("domain 0")[3], transform_step as f32, "step {number}");
        numbers.push(number);
    }
    Ok(numbers)
}

#[test]
fn states_are_read_as_written_from_any_time() {
    let folder = tempfile::tempdir().expect("a folder");
    let steps = 5 * RATE;
    let path = write(folder.path(), "whole.mcap", &recording(steps, 25));
    let recording = Recording::open(&path).expect("a recording");
    assert_eq!(recording.end_time(), (steps - 1) * SECOND / RATE);
    assert_eq!(step_numbers(&recording, 0).expect("states"), (0..steps).collect::<Vec<_>>());
    for first in [1, 24, 25, 119, 120, 121, 130, 299] {
        let time = (first as f64 / RATE as f64 * 1e9).round() as u64;
        let expected: Vec<u64> = (first..steps).collect();
        assert_eq!(step_numbers(&recording, time).expect("states"), expected, "from step {first}");
        // Half a step later, the state of the step is still the current one.
        let later = time + SECOND / RATE / 2;
        assert_eq!(step_numbers(&recording, later).expect("states"), expected, "after step {first}");
    }
    let mut states = recording.states(SECOND, 2 * SECOND).expect("states");
    let mut count = 0;
    while let Some(recorded) = states.next().expect("a state") {
        assert_eq!(recorded.sent_values.is_complete, count == 0 || recorded.state.step.number == 2 * RATE);
        count += 1;
    }
    assert_eq!(count, RATE + 1);
}

/// The recorder replaces a change by a complete state every two seconds, and every 1,000 states if the time stands
/// still.
#[test]
fn complete_states_are_at_most_two_seconds_apart() {
    let complete_steps = |time_scale: f64, steps: u64| {
        let mut writer = begin(Vec::new(), true);
        for step in 0..steps {
            let mut chunk = state(step, 1);
            let id = chunk.head.as_mut().and_then(|head| head.step.as_mut()).expect("a head");
            id.time *= time_scale;
            writer.state_chunk(chunk).expect("a written state");
        }
        let folder = tempfile::tempdir().expect("a folder");
        let path = write(folder.path(), "file.mcap", &writer.finish().expect("a written file"));
        let mut states = Recording::open(path).expect("a recording").states(0, u64::MAX).expect("states");
        let mut complete = Vec::new();
        while let Some(recorded) = states.next().expect("a state") {
            if recorded.sent_values.is_complete {
                complete.push(recorded.state.step.number);
            }
        }
        complete
    };
    assert_eq!(complete_steps(1.0, 500), [0, 120, 240, 360, 480]);
    assert_eq!(complete_steps(0.0, 2100), [0, 1000, 2000]);
}

/// All state messages of a file.
fn state_messages(path: &Path) -> Vec<(u64, Vec<u8>)> {
    let mut messages = Recording::open(path).expect("a recording").messages(&[Topic::States]);
    let mut list = Vec::new();
    while let Some(message) = messages.next().expect("a message") {
        list.push((message.time, message.data.to_vec()));
    }
    list
}

/// Chunks depend on when data arrive, and stage times differ between recordings, but the messages are the same.
#[test]
fn state_messages_do_not_depend_on_chunks_and_stages() {
    let folder = tempfile::tempdir().expect("a folder");
    let first = write(folder.path(), "first.mcap", &recording(200, 7));
    let mut writer = begin(Vec::new(), true);
    for step in 0..200 {
        let mut chunk = state(step, 1);
        chunk.head.as_mut().expect("a head").stages.clear();
        writer.state_chunk(chunk).expect("a written state");
    }
    let second = write(folder.path(), "second.mcap", &writer.finish().expect("a written file"));
    assert_eq!(state_messages(&first), state_messages(&second));
    let other_run = begin_with_run(2);
    let third = write(folder.path(), "third.mcap", &other_run);
    assert_ne!(state_messages(&first), state_messages(&third), "control: expected another run to differ");
}

fn begin_with_run(run: u64) -> Vec<u8> {
    let mut writer = begin(Vec::new(), true);
    (0..200).for_each(|step| writer.state_chunk(state(step, run)).expect("a written state"));
    writer.finish().expect("a written file")
}

#[test]
fn contents_are_compared_with_their_hashes() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = write(folder.path(), "whole.mcap", &recording(3, 3));
    let description = Recording::open(path)
        .and_then(|recording| {
            let arrays = [modalcast_client::ShapeArray::RestPositions, modalcast_client::ShapeArray::Modes];
            recording.read_description(&arrays, true)
        })
        .expect("contents");
    assert_eq!((description.shapes[0].rest_positions[3], description.shapes[0].modes[17]), (1.0, 17.0 / 16.0));

    let mut writer = begin(Vec::new(), false);
    writer.state_chunk(state(0, 1)).expect("a written state");
    let path = write(folder.path(), "by-hash.mcap", &writer.finish().expect("a written file"));
    let error = Recording::open(path).expect("a recording").read_contents(|_, _| Ok(())).expect_err("only hashes");
    assert!(matches!(error, Error::Unavailable { .. }) && error.exit_code() == 5, "{error}");
}

/// Recovers a prefix of a file, and returns the recovered steps.
fn recover_prefix(folder: &Path, file: &[u8], length: usize) -> Result<Vec<u64>> {
    let (cut, out) = (write(folder, "cut.mcap", &file[..length]), folder.join("out.mcap"));
    recover(&cut, &out)?;
    step_numbers(&Recording::open(&out)?, 0)
}

/// Cuts a recording at every byte around the ends of records, and at random bytes: every whole chunk is recovered, and
/// a file without a whole state is an error.
#[test]
fn every_prefix_is_recovered_up_to_its_last_whole_chunk() {
    let folder = tempfile::tempdir().expect("a folder");
    let (steps, per_chunk) = (60, 20);
    let file = recording(steps, per_chunk);
    let chunk_ends = record_ends(&file, CHUNK);
    // One chunk of the scene and the first states, and two of states.
    assert_eq!(chunk_ends.len(), 3);
    let all_ends: Vec<usize> = (0..=u8::MAX).flat_map(|opcode| record_ends(&file, opcode)).collect();
    let near = all_ends.iter().flat_map(|end| end.saturating_sub(12)..(end + 12).min(file.len()));
    let mut random = fastrand::Rng::with_seed(5);
    let lengths = near.chain((0..300).map(|_| random.usize(..file.len()))).chain([0, file.len()]);
    for length in lengths {
        let whole_chunks = chunk_ends.iter().filter(|end| **end <= length).count() as u64;
        match recover_prefix(folder.path(), &file, length) {
            Ok(numbers) => assert_eq!(numbers, (0..whole_chunks * per_chunk).collect::<Vec<_>>(), "{length} bytes"),
            Err(error) => {
                assert_eq!((whole_chunks, error.exit_code()), (0, 3), "{length} bytes: {error}");
            }
        }
        if length < file.len() {
            let error = Recording::open(folder.path().join("cut.mcap")).err().expect("a cut file has no index");
            assert_eq!(error.exit_code(), 3, "{error}");
        }
    }
}

/// The ends of all records with this opcode outside of chunks. A file begins and ends with 8 magic bytes, and a record
/// begins with its opcode and its length as u64.
fn record_ends(file: &[u8], opcode: u8) -> Vec<usize> {
    let (mut ends, mut start) = (Vec::new(), 8);
    while start + 9 <= file.len() - 8 {
        let length = u64::from_le_bytes(file[start + 1..start + 9].try_into().expect("eight bytes")) as usize;
        let end = start + 9 + length;
        if file[start] == opcode {
            ends.push(end);
        }
        start = end;
    }
    ends
}

/// Reads everything in a file.
fn read_everything(path: &Path) -> Result<()> {
    let recording = Recording::open(path)?;
    recording.read_contents(|_, _| Ok(()))?;
    recording.read_description(&[modalcast_client::ShapeArray::Modes], true)?;
    for from in [0, SECOND / 2] {
        let mut states = recording.states(from, u64::MAX)?;
        while states.next()?.is_some() {}
    }
    let mut messages = recording.messages(&Topic::ALL);
    while messages.next()?.is_some() {}
    Ok(())
}

/// Changed bytes give an error or are not noticed.
#[test]
fn damaged_files_cause_no_panic_and_no_endless_loop() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = recording(60, 20);
    let path = write(folder.path(), "whole.mcap", &file);
    read_everything(&path).expect("control: the undamaged file");
    let mut random = fastrand::Rng::with_seed(11);
    let mut errors = 0;
    for round in 0..600 {
        let mut damaged = file.clone();
        for _ in 0..1 + round % 4 {
            let index = random.usize(..damaged.len());
            damaged[index] = match round % 3 {
                0 => 0xff,
                1 => damaged[index] ^ (1 << random.u8(..8)),
                _ => random.u8(..),
            };
        }
        let path = write(folder.path(), "damaged.mcap", &damaged);
        errors += usize::from(read_everything(&path).is_err());
        recover(&path, &folder.path().join("out.mcap")).ok();
    }
    assert!(errors > 200, "expected more than 200 errors of 600 damaged files, got {errors}");
}

/// The length of each record in turn is replaced by 2^40 bytes or more.
#[test]
fn huge_lengths_cause_no_panic_and_other_files_are_errors() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = recording(60, 20);
    let starts = (0..=u8::MAX).flat_map(|opcode| record_ends(&file, opcode));
    for start in starts.filter(|start| start + 9 < file.len()) {
        for huge in [u64::MAX, 1 << 63, u64::MAX - 8, 1 << 40] {
            let mut damaged = file.clone();
            damaged[start + 1..start + 9].copy_from_slice(&huge.to_le_bytes());
            let path = write(folder.path(), "damaged.mcap", &damaged);
            // A record of the index that is not needed may be damaged.
            read_everything(&path).ok();
            recover(&path, &folder.path().join("out.mcap")).ok();
        }
    }
    let missing = Recording::open(folder.path().join("missing.mcap")).err().expect("no file");
    assert_eq!(missing.exit_code(), 4);
    let other = write(folder.path(), "other.mcap", b"not a recording");
    assert!(Recording::open(other).err().expect("another file").to_string().contains("MCAP"));
}

/// Otherwise a small file would contain any number of messages.
#[test]
fn index_names_chunks_and_metadata_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = recording(60, 20);
    let ends: Vec<usize> = (0..=u8::MAX).flat_map(|opcode| record_ends(&file, opcode)).collect();
    // Opcodes of indexes of chunks and of metadata.
    for (opcode, location) in [(8, "index of the chunk at"), (13, "index of the metadata")] {
        let end = record_ends(&file, opcode)[0];
        let start = *ends.iter().filter(|other| **other < end).max().expect("records before the index");
        let repeated = [&file[..end], &file[start..]].concat();
        let path = write(folder.path(), "repeated.mcap", &repeated);
        let error = Recording::open(path).err().expect("a repeated entry").to_string();
        assert!(error.contains(location), "{error}");
    }
}

#[test]
fn kept_recordings_of_the_fuzzer_neither_panic_nor_use_much_memory() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/fuzz");
    fuzz_replay::replay("kept_recordings_of_the_fuzzer_neither_panic_nor_use_much_memory", || {
        let target = fuzz_target::RecordingTarget::new();
        let inputs = [vec![recording(10, 4)], fuzz_replay::kept_inputs(&fuzz, "recording")].concat();
        inputs.iter().for_each(|input| target.run(input));
    });
}
