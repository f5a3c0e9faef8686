//! A run that continues from a checkpoint computes the same bits as a run without interruption, for all kinds of motion.

use serde_json::Value;

use crate::bridge::{BridgeOptions, BridgeScenario, LoadDirection};
use crate::checkpoint::{Checkpoint, RunIdentity};
use crate::cubic::tests::spring_chain;
use crate::error::Result;
use crate::hierarchy::tests::four_domain_model;
use crate::implicit::ImplicitMethod;
use crate::loads::DomainLoads;
use crate::run::Scenario;
use crate::step_values::StepValues;
use crate::sweep::{SweepOptions, SweepScenario};
use crate::tree::{TreeOptions, TreeScenario};
use crate::vega::VegaSettings;

const STEPS: u64 = 150;

/// The first step, the steps around a change of the forces, and others.
const CUTS: [u64; 7] = [0, 1, 39, 40, 41, 77, STEPS];

const TREE: TreeOptions = TreeOptions { dt: 1.0 / 60.0, wind_speed: 8.0, direction_radians: 0.4, seed: 7 };

const BRIDGE: BridgeOptions = BridgeOptions {
    domain: 0,
    // Few steps per period, so that a step needs sub-steps.
    dt: 0.1,
    deflection_fraction: 0.03,
    period: 2.0,
    load_direction: LoadDirection::Across,
    method: ImplicitMethod::AverageVectorField,
    has_fixed_step: false,
};

/// A kind of motion.
struct Motion {
    name: &'static str,
    create: fn() -> Box<dyn Scenario>,
    /// The forces of viewers from step 40 and from step 100 on.
    viewer_forces: Option<[[f64; 6]; 2]>,
    /// Numbers of the state at step 77 that change the later motion.
    numbers: &'static [&'static str],
}

fn tree(options: TreeOptions) -> Box<dyn Scenario> {
    Box::new(TreeScenario::new(four_domain_model(), options).expect("a valid scenario"))
}

fn bridge(options: BridgeOptions) -> Box<dyn Scenario> {
    let settings = VegaSettings { damping_stiffness: 0.003, ..VegaSettings::default() };
    let bridge = BridgeScenario::new(four_domain_model(), spring_chain(&[40.0, 90.0], 30.0, 4.0), &settings, options);
    Box::new(bridge.expect("a valid scenario"))
}

fn sweep(is_rigid: bool) -> Box<dyn Scenario> {
    let mut model = four_domain_model();
    if is_rigid {
        model.domains.iter_mut().for_each(|domain| (domain.rank, domain.first_coordinate) = (0, 0));
        model.coordinate_count = 0;
    }
    let options = SweepOptions { dt: 1.0 / 60.0, steps: Some(STEPS), displacement_fraction: 0.06 };
    Box::new(SweepScenario::new(model, options))
}

const MOTIONS: [Motion; 8] = [
    Motion {
        name: "tree in wind",
        create: || tree(TREE),
        viewer_forces: None,
        numbers: &["/motion/state/q/0", "/motion/state/v/1", "/motion/forces/2"],
    },
    Motion {
        name: "tree in wind and forces of viewers",
        create: || tree(TREE),
        viewer_forces: Some([[0.0, 0.0, 2.0, 0.0, 0.0, -1.0], [1.0; 6]]),
        numbers: &["/motion/state/q/0", "/motion/state/q/2", "/motion/viewer_forces/5"],
    },
    Motion {
        name: "modes under forces of viewers",
        create: || tree(TreeOptions { wind_speed: 0.0, ..TREE }),
        viewer_forces: Some([[3.0, 0.0, 2.0, 0.0, 0.0, -1.0], [1e30; 6]]),
        numbers: &["/motion/state/q/0", "/motion/state/v/2", "/motion/viewer_forces/5"],
    },
    Motion {
        name: "bridge",
        create: || bridge(BRIDGE),
        viewer_forces: None,
        numbers: &["/state/q/0", "/state/q/1", "/state/v/0", "/state/sub_steps"],
    },
    Motion {
        name: "bridge under forces of viewers",
        create: || bridge(BridgeOptions { method: ImplicitMethod::BackwardEuler, ..BRIDGE }),
        viewer_forces: Some([[5.0, 0.0, 1.0, 1.0, 1.0, 1.0], [1e30; 6]]),
        numbers: &["/state/v/1", "/viewer_load/0", "/viewer_response/state/q/3", "/viewer_response/forces/4"],
    },
    Motion {
        name: "bridge with fixed steps",
        create: || bridge(BridgeOptions { has_fixed_step: true, ..BRIDGE }),
        viewer_forces: None,
        numbers: &["/state/q/0", "/state/v/0"],
    },
    Motion { name: "sweep", create: || sweep(false), viewer_forces: None, numbers: &[] },
    Motion { name: "rocking", create: || sweep(true), viewer_forces: None, numbers: &[] },
];

/// The bits of all coordinates and transforms of a step.
type StepBits = Vec<u32>;

impl Motion {
    /// Computes the steps from `first_step` to `end`. With `gets_forces`, the first step gets the present forces, as in a
    /// process that subscribes to them.
    fn run(&self, scenario: &mut dyn Scenario, first_step: u64, end: u64, gets_forces: bool) -> Vec<StepBits> {
        let mut compute_step = |step: u64| {
            if let Some([first, second]) = &self.viewer_forces
                && step >= 40
            {
                let is_new = step == 40 || step == 100 || (gets_forces && step == first_step);
                let forces = if step < 100 { first } else { second };
                let loads = DomainLoads::of_coordinates(scenario.model(), forces);
                is_new.then(|| scenario.set_viewer_forces(&loads).expect("a scenario with forces"));
            }
            let mut values = StepValues::default();
            scenario.compute_next_step(&mut values).expect("the next step");
            values.q.iter().chain(values.transforms.as_flattened()).map(|number| number.to_bits()).collect()
        };
        (first_step..end).map(&mut compute_step).collect()
    }

    /// Runs to `cut`, and returns the checkpoint as a file has it.
    fn run_to(&self, cut: u64) -> Checkpoint {
        let mut scenario = (self.create)();
        self.run(scenario.as_mut(), 0, cut, false);
        let state = scenario.save().expect("a state");
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("run.checkpoint");
        let checkpoint = Checkpoint { identity: RunIdentity::default(), next_step: cut, recorded_rows: None, state };
        checkpoint.write(&path).expect("a writable folder");
        Checkpoint::read(&path, scenario.model()).expect("a valid file")
    }

    /// Continues from a state in a new process: a new scenario.
    fn continue_from(&self, next_step: u64, state: Value, gets_forces: bool) -> Result<(Vec<StepBits>, Value)> {
        let mut scenario = (self.create)();
        scenario.restore(next_step, state)?;
        let steps = self.run(scenario.as_mut(), next_step, STEPS, gets_forces);
        Ok((steps, Value::Object(scenario.report())))
    }
}

#[test]
fn continued_runs_have_the_bits_of_uninterrupted_ones() {
    for motion in &MOTIONS {
        let mut scenario = (motion.create)();
        let all_steps = motion.run(scenario.as_mut(), 0, STEPS, false);
        let report = Value::Object(scenario.report());
        for (cut, gets_forces) in CUTS.into_iter().flat_map(|cut| [(cut, false), (cut, true)]) {
            let Checkpoint { next_step, state, .. } = motion.run_to(cut);
            let (steps, continued_report) = motion.continue_from(next_step, state, gets_forces).expect("a valid state");
            assert!(steps == all_steps[cut as usize..], "{}: other bits after step {cut}", motion.name);
            assert_eq!(continued_report, report, "{}, step {cut}", motion.name);
        }
        assert_ne!(all_steps[77], all_steps[STEPS as usize - 1], "control: expected motion in {}", motion.name);
    }
}

/// The number of sub-steps is part of the state: a step begins with that of the step before.
#[test]
fn bridge_is_cut_between_steps_with_several_sub_steps() {
    let Checkpoint { state, .. } = MOTIONS[3].run_to(77);
    assert!(state.pointer("/state/sub_steps").and_then(Value::as_u64).expect("a number") > 1, "{state}");
}

/// One changed bit of the state changes the steps: the comparison above would detect a number that is not restored.
#[test]
fn every_number_of_the_state_matters() {
    for motion in &MOTIONS {
        let Checkpoint { next_step, state, .. } = motion.run_to(77);
        let (steps, _) = motion.continue_from(next_step, state.clone(), false).expect("a valid state");
        for name in motion.numbers {
            let mut altered = state.clone();
            let number = altered.pointer_mut(name).unwrap_or_else(|| panic!("{}: no {name}", motion.name));
            let bits = number.as_u64().expect("a number");
            // A bit of the mantissa that f32 has, or one sub-step more.
            *number = if name.ends_with("sub_steps") { (bits + 1).into() } else { (bits ^ 1 << 45).into() };
            assert_ne!(*number, Value::from(bits), "control");
            let (altered_steps, _) = motion.continue_from(next_step, altered, false).expect("a valid state");
            assert!(altered_steps != steps, "{}: {name} does not matter", motion.name);
        }
    }
    // The motion of a sweep follows from the number of the step.
    let sweep = &MOTIONS[6];
    let (steps, _) = sweep.continue_from(77, sweep.run_to(77).state, false).expect("a valid state");
    let (shifted_steps, _) = sweep.continue_from(78, sweep.run_to(77).state, false).expect("a valid state");
    assert_ne!(steps[0], shifted_steps[0]);
}

/// A file with a valid hash but another content is an error with the name of the field.
#[test]
fn states_of_other_scenarios_are_rejected() {
    let tree_state = MOTIONS[1].run_to(77).state;
    let bridge_state = MOTIONS[4].run_to(77).state;
    let error = |motion: &Motion, state: &Value| {
        motion.continue_from(77, state.clone(), false).expect_err("a state").to_string()
    };
    assert!(error(&MOTIONS[0], &bridge_state).starts_with("state: expected"));
    assert!(error(&MOTIONS[3], &tree_state).starts_with("state: expected"));
    assert!(error(&MOTIONS[6], &Value::Null).starts_with("state: expected"));
    let alter = |state: &Value, name: &str, value: Value| {
        let mut altered = state.clone();
        *altered.pointer_mut(name).unwrap_or_else(|| panic!("no {name}")) = value;
        altered
    };
    let not_finite = || Value::from(f64::NAN.to_bits());
    for (motion, state, names) in [
        (
            &MOTIONS[1],
            &tree_state,
            ["/motion/state/q", "/motion/state/v", "/motion/forces", "/motion/viewer_forces"].as_slice(),
        ),
        (&MOTIONS[4], &bridge_state, &["/state/q", "/viewer_response/state/v", "/viewer_response/forces"]),
    ] {
        for vector in names {
            let given = error(motion, &alter(state, vector, Value::Array(vec![])));
            assert!(given.starts_with("state.") && given.ends_with("got 0"), "{given}");
            let given = error(motion, &alter(state, &format!("{vector}/1"), not_finite()));
            assert!(given.ends_with("expected a finite number, got NaN"), "{given}");
        }
    }
    let given = error(&MOTIONS[4], &alter(&bridge_state, "/viewer_load", Value::Array(vec![])));
    assert_eq!(given, "state.viewer_load: expected 2 numbers, got 0");
}
