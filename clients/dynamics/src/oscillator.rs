//! Exact time integration of one mode, q'' + 2 zeta omega q' + omega^2 q = f, with a force that is linear within a
//! step.
//!
//! With time in units of the step h, p = h q' and y = (q, p), the mode is the 2 x 2 system y' = M y + h^2 e2 f. Here
//! w = omega h, M = [[0, 1], [-w^2, -2 zeta w]] and e2 = (0, 1). All coefficients follow from the impulse response S(t)
//! and its derivative S'. The free motion is exp(M) = [[C, S], [-w^2 S, S']] with C = S' + 2 zeta w S. The step
//! response is G1 = integral of S, and the ramp response is G2 = integral of G1. There are three formulas for S.
//! `Response::compute` selects the accurate one by w and zeta.

use crate::error::{Result, invalid_input};

/// The coefficients of one step of one mode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Oscillator {
    /// h, in seconds.
    step: f64,
    response: Response,
    /// w^2 = (omega h)^2.
    w_squared: f64,
}

/// Displacement and velocity of one mode.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ModeState {
    pub q: f64,
    pub v: f64,
}

/// Responses after one step, with time in units of the step.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Response {
    /// C: displacement after a unit initial displacement.
    cosine: f64,
    /// S: displacement after a unit impulse.
    impulse: f64,
    /// S': velocity after a unit impulse.
    impulse_rate: f64,
    /// G1: displacement under a unit force.
    constant: f64,
    /// G2: displacement under a force that increases from 0 to 1.
    ramp: f64,
}

impl Oscillator {
    /// A mode with eigenvalue omega^2 in (rad/s)^2 and damping ratio zeta, integrated in steps of `step` seconds.
    ///
    /// # Errors
    /// `Invalid` unless the eigenvalue is finite and not negative, zeta is 0 to 1000, and the step is finite and
    /// positive.
    pub fn new(eigenvalue: f64, damping_ratio: f64, step: f64) -> Result<Self> {
        if !(eigenvalue.is_finite() && eigenvalue >= 0.0) {
            return Err(invalid_input("eigenvalue", "a finite number >= 0", eigenvalue));
        }
        if !(0.0..=1000.0).contains(&damping_ratio) {
            return Err(invalid_input("damping_ratio", "0 to 1000", damping_ratio));
        }
        if !(step.is_finite() && step > 0.0) {
            return Err(invalid_input("dt", "a positive number of seconds", step));
        }
        let w = eigenvalue.sqrt() * step;
        Ok(Self { step, response: Response::compute(w, damping_ratio), w_squared: w * w })
    }

    /// A mode that never moves, in place of a mode without stiffness, which would drift without bound under a steady
    /// force.
    pub fn new_fixed() -> Self {
        Self { step: 1.0, response: Response::default(), w_squared: 0.0 }
    }

    /// The displacement at rest per unit of force, 1 / omega^2; 0 for a mode that never moves.
    pub fn compliance(&self) -> f64 {
        if self.w_squared > 0.0 { self.step * self.step / self.w_squared } else { 0.0 }
    }

    /// The state one step later, under a force that changes linearly from `start_force` to `end_force`.
    #[must_use]
    pub fn advance(&self, state: ModeState, start_force: f64, end_force: f64) -> ModeState {
        let (h, response) = (self.step, &self.response);
        let (p, scaled_force, scaled_force_change) =
            (h * state.v, h * h * start_force, h * h * (end_force - start_force));
        let q = response.cosine * state.q
            + response.impulse * p
            + response.constant * scaled_force
            + response.ramp * scaled_force_change;
        let p = -self.w_squared * response.impulse * state.q
            + response.impulse_rate * p
            + response.impulse * scaled_force
            + response.constant * scaled_force_change;
        ModeState { q, v: p / h }
    }
}

impl Response {
    /// Selects the formula without cancellation. w = omega h; zeta is the damping ratio.
    fn compute(w: f64, zeta: f64) -> Self {
        let sigma = zeta * w;
        if w * w + 2.0 * sigma <= 1.0 {
            return Self::from_series(w, sigma);
        }
        // Above this damping ratio the two real roots are far enough apart for divided differences.
        if zeta > 1.15 { Self::from_real_roots(w, sigma) } else { Self::from_complex_roots(w, sigma) }
    }

    /// The power series of S for short steps, because the closed forms suffer from cancellation there. Its coefficients
    /// are s_0 = 0, s_1 = 1 and (k + 1)(k + 2) s_{k+2} = -2 sigma (k + 1) s_{k+1} - w^2 s_k.
    fn from_series(w: f64, sigma: f64) -> Self {
        let mut sum = Self::default();
        let (mut term, mut next_term) = (0.0, 1.0);
        // w^2 + 2 sigma is at most 1 here, so the terms after the first 40 are below the rounding error.
        for k in 0..40 {
            let order = f64::from(k);
            sum.impulse += term;
            sum.impulse_rate += order * term;
            sum.constant += term / (order + 1.0);
            sum.ramp += term / ((order + 1.0) * (order + 2.0));
            let numerator = -2.0 * sigma * (order + 1.0) * next_term - w * w * term;
            (term, next_term) = (next_term, numerator / ((order + 1.0) * (order + 2.0)));
        }
        sum.cosine = 1.0 - w * w * sum.constant;
        sum
    }

    /// Underdamped, critically damped and slightly overdamped modes, whose roots are complex or close together:
    /// e^-sigma times cosine and sine, or cosh and sinh.
    fn from_complex_roots(w: f64, sigma: f64) -> Self {
        // d is h times the damped angular frequency: d^2 = w^2 - sigma^2.
        let d_squared = (w - sigma) * (w + sigma);
        let d = d_squared.abs().sqrt();
        let decay = (-sigma).exp();
        // e^-sigma cos(d) and e^-sigma sin(d)/d, or cosh and sinh for a negative d_squared.
        let (cosine_term, sine_term) = if d < 1e-4 {
            // Taylor expansion; the error is of fourth order in d, below 1e-16.
            (decay * (1.0 - d_squared / 2.0), decay * (1.0 - d_squared / 6.0))
        } else if d_squared > 0.0 {
            (decay * d.cos(), decay * d.sin() / d)
        } else {
            // cosh and sinh would overflow for large d, while these exponents stay negative.
            let (slow_decay, fast_decay) = ((d - sigma).exp(), (-d - sigma).exp());
            (0.5 * (slow_decay + fast_decay), 0.5 * (slow_decay - fast_decay) / d)
        };
        let (impulse, cosine) = (sine_term, cosine_term + sigma * sine_term);
        let constant = (1.0 - cosine) / (w * w);
        let ramp = (1.0 - 2.0 * sigma * constant - impulse) / (w * w);
        Self { cosine, impulse, impulse_rate: cosine_term - sigma * sine_term, constant, ramp }
    }

    /// Overdamped modes with two well separated real roots: the responses are divided differences of e^z, (e^z - 1)/z
    /// and (e^z - 1 - z)/z^2.
    fn from_real_roots(w: f64, sigma: f64) -> Self {
        let half_distance = ((sigma - w) * (sigma + w)).sqrt();
        let fast_root = -(sigma + half_distance);
        // The product of the roots is w^2.
        let slow_root = w / fast_root * w;
        let distance = slow_root - fast_root;
        let divided_difference = |function: fn(f64) -> f64| (function(slow_root) - function(fast_root)) / distance;
        Self {
            cosine: (slow_root * fast_root.exp() - fast_root * slow_root.exp()) / distance,
            impulse: divided_difference(f64::exp),
            impulse_rate: (slow_root * slow_root.exp() - fast_root * fast_root.exp()) / distance,
            constant: divided_difference(phi1),
            ramp: divided_difference(phi2),
        }
    }
}

/// (e^z - 1) / z.
fn phi1(z: f64) -> f64 {
    if z == 0.0 { 1.0 } else { z.exp_m1() / z }
}

/// (e^z - 1 - z) / z^2.
fn phi2(z: f64) -> f64 {
    if z.abs() > 0.5 {
        return (z.exp_m1() - z) / (z * z);
    }
    // Horner's scheme for the sum of z^k / (k + 2)!, without cancellation near 0.
    (0..16).rev().fold(0.0, |sum, k| if k == 0 { (1.0 + sum) / 2.0 } else { (1.0 + sum) * z / f64::from(k + 2) })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Damping ratios of all regimes and of their borders.
    const ZETAS: [f64; 9] = [0.0, 0.03, 0.7, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.2, 5.0, 80.0];

    fn omega(hertz: f64) -> f64 {
        2.0 * std::f64::consts::PI * hertz
    }

    /// Frequencies from 0.1 Hz to 100 kHz, steps from 1 microsecond to 10 seconds, and all damping ratios, as
    /// (hertz, h, zeta).
    fn parameter_grid() -> impl Iterator<Item = (f64, f64, f64)> {
        let steps = [1e-6, 1e-4, 1.0 / 60.0, 0.3, 10.0];
        let hertz = [0.1, 1.0, 7.3, 440.0, 2e4, 1e5];
        hertz.into_iter().flat_map(move |f| steps.into_iter().flat_map(move |h| ZETAS.map(|zeta| (f, h, zeta))))
    }

    /// An independent solution of q'' + damping q' + eigenvalue q = force after h seconds: fourth-order Runge-Kutta in
    /// 20,000 small steps.
    fn integrate_runge_kutta(
        eigenvalue: f64,
        damping: f64,
        start: ModeState,
        start_force: f64,
        end_force: f64,
        h: f64,
    ) -> ModeState {
        let count = 20_000;
        let dt = h / f64::from(count);
        let derivative = |time: f64, state: ModeState| {
            let force = start_force + (end_force - start_force) * time / h;
            ModeState { q: state.v, v: force - damping * state.v - eigenvalue * state.q }
        };
        let add_scaled = |state: ModeState, d: ModeState, factor: f64| ModeState {
            q: state.q + factor * d.q,
            v: state.v + factor * d.v,
        };
        (0..count).fold(start, |state, index| {
            let t = f64::from(index) * dt;
            let a = derivative(t, state);
            let b = derivative(t + dt / 2.0, add_scaled(state, a, dt / 2.0));
            let c = derivative(t + dt / 2.0, add_scaled(state, b, dt / 2.0));
            let d = derivative(t + dt, add_scaled(state, c, dt));
            [(a, 1.0), (b, 2.0), (c, 2.0), (d, 1.0)]
                .iter()
                .fold(state, |sum, (k, weight)| add_scaled(sum, *k, weight * dt / 6.0))
        })
    }

    #[test]
    fn step_agrees_with_fine_runge_kutta_integration() {
        let start = ModeState { q: 0.3, v: -0.2 };
        for w in [1e-4, 0.02, 0.5, 0.9, 1.1, 3.0, 20.0] {
            for zeta in ZETAS {
                // w = omega h, eigenvalue = omega^2 and damping = 2 zeta omega.
                let (h, eigenvalue) = (0.25, (w / 0.25) * (w / 0.25));
                let damping = 2.0 * zeta * w / h;
                // The Runge-Kutta solution is too inaccurate for stronger damping.
                if damping * h > 2000.0 {
                    continue;
                }
                let expected = integrate_runge_kutta(eigenvalue, damping, start, 1.0, -2.5, h);
                let mode = Oscillator::new(eigenvalue, zeta, h).expect("valid parameters");
                let state = mode.advance(start, 1.0, -2.5);
                let is_close = (state.q - expected.q).abs() <= 1e-9 && (state.v - expected.v).abs() <= 1e-8;
                assert!(is_close, "w {w} zeta {zeta}: expected {expected:?}, got {state:?}");
            }
        }
    }

    #[test]
    fn one_long_step_equals_many_short_steps() {
        for (hertz, h, zeta) in parameter_grid() {
            let (eigenvalue, step_count) = (omega(hertz).powi(2), 64_u32);
            let start = ModeState { q: 1.0, v: 0.5 * omega(hertz) };
            let force = |step: u32| eigenvalue * (0.5 - f64::from(step) / f64::from(step_count));
            let long_step = Oscillator::new(eigenvalue, zeta, h).expect("valid parameters");
            let short_step = Oscillator::new(eigenvalue, zeta, h / f64::from(step_count)).expect("valid parameters");
            let state = long_step.advance(start, force(0), force(step_count));
            let expected =
                (0..step_count).fold(start, |state, step| short_step.advance(state, force(step), force(step + 1)));
            // The rounding error of the phase is proportional to the phase angle of the step.
            let tolerance = 1e-9 + 1e-14 * omega(hertz) * h;
            let is_close =
                (state.q - expected.q).abs() <= tolerance && (state.v - expected.v).abs() <= tolerance * omega(hertz);
            assert!(is_close, "{hertz} Hz, {h} s, zeta {zeta}: expected {expected:?}, got {state:?}");
        }
    }

    #[test]
    fn free_motion_gains_no_energy_and_stays_bounded() {
        for (hertz, h, zeta) in parameter_grid() {
            let eigenvalue = omega(hertz).powi(2);
            let mode = Oscillator::new(eigenvalue, zeta, h).expect("valid parameters");
            let energy = |state: ModeState| 0.5 * (state.v * state.v + eigenvalue * state.q * state.q);
            let mut state = ModeState { q: 1.0, v: omega(hertz) };
            for _ in 0..2000 {
                let next = mode.advance(state, 0.0, 0.0);
                let gains_energy = energy(next) > energy(state) * (1.0 + 1e-12);
                assert!(!gains_energy && next.q.is_finite(), "{hertz} Hz, {h} s, zeta {zeta}: {state:?} to {next:?}");
                state = next;
            }
        }
    }

    #[test]
    fn undamped_mode_conserves_energy_over_a_million_steps() {
        for (hertz, h) in [(0.1, 1e-3), (1.7, 1.0 / 60.0), (300.0, 1.0 / 60.0), (1e5, 1.0)] {
            let eigenvalue = omega(hertz).powi(2);
            let mode = Oscillator::new(eigenvalue, 0.0, h).expect("valid parameters");
            let energy = |state: ModeState| state.v * state.v + eigenvalue * state.q * state.q;
            let start = ModeState { q: 1.0, v: 0.0 };
            let end = (0..1_000_000).fold(start, |state, _| mode.advance(state, 0.0, 0.0));
            let drift = energy(end) / energy(start) - 1.0;
            assert!(drift.abs() <= 1e-9, "{hertz} Hz, {h} s: energy drifts by {drift}");
        }
    }

    /// The sum of two numbers with about 32 digits.
    #[derive(Clone, Copy)]
    struct DoubleDouble(f64, f64);

    impl DoubleDouble {
        /// 2 pi.
        const TAU: Self = Self(std::f64::consts::TAU, 2.449_293_598_294_706_4e-16);

        /// a + b without rounding, for |a| >= |b|.
        fn quick_sum(a: f64, b: f64) -> Self {
            let sum = a + b;
            Self(sum, b - (sum - a))
        }

        fn product(a: f64, b: f64) -> Self {
            Self(a * b, a.mul_add(b, -(a * b)))
        }

        fn times(self, factor: f64) -> Self {
            let high = Self::product(self.0, factor);
            Self::quick_sum(high.0, high.1 + self.1 * factor)
        }

        fn minus(self, other: Self) -> Self {
            // Knuth's sum of the high parts.
            let (a, b) = (self.0, -other.0);
            let sum = a + b;
            let b_part = sum - a;
            let error = (a - (sum - b_part)) + (b - b_part);
            Self::quick_sum(sum, error + self.1 - other.1)
        }

        fn square_root(number: f64) -> Self {
            let root = number.sqrt();
            let square = Self::product(root, root);
            Self::quick_sum(root, ((number - square.0) - square.1) / (2.0 * root))
        }
    }

    /// Phase in radians and amplitude of undamped modes of 1e-3 Hz to 1e6 Hz after `steps` steps of 1/60 s, as
    /// (hertz, error of the phase, relative error of the amplitude). The reference is the solution in about 32 digits
    /// at the eigenvalue and the step as f64 has them.
    fn phase_errors(steps: u32) -> Vec<(f64, f64, f64)> {
        let h = 1.0_f64 / 60.0;
        let error = |exponent: i32| {
            let hertz = 10.0_f64.powi(exponent);
            let eigenvalue = omega(hertz).powi(2);
            let mode = Oscillator::new(eigenvalue, 0.0, h).expect("valid parameters");
            let start = ModeState { q: 1.0, v: 0.0 };
            let end = (0..steps).fold(start, |state, _| mode.advance(state, 0.0, 0.0));
            let phase = DoubleDouble::square_root(eigenvalue).times(h).times(f64::from(steps));
            let turns = (phase.0 / DoubleDouble::TAU.0).round();
            let expected_phase = phase.minus(DoubleDouble::TAU.times(turns)).0;
            let (x, y) = (end.q, -end.v / eigenvalue.sqrt());
            let phase_error = y.atan2(x) - expected_phase;
            let phase_error = phase_error - (phase_error / DoubleDouble::TAU.0).round() * DoubleDouble::TAU.0;
            (hertz, phase_error.abs(), (x.hypot(y) - 1.0).abs())
        };
        (-3..=6).map(error).collect()
    }

    /// The rounding of omega h grows with the number of steps: 2e-5 rad at 1e6 steps.
    #[test]
    fn phase_and_amplitude_agree_with_the_exact_solution() {
        for (hertz, phase_error, amplitude_error) in phase_errors(10_000) {
            assert!(phase_error <= 2e-7, "{hertz} Hz: expected the exact phase, got an error of {phase_error}");
            assert!(amplitude_error <= 1e-11, "{hertz} Hz: {amplitude_error}");
        }
        // Control: the reference tells a relative change of the step of 1e-13 from the step itself.
        let phase = |h: f64| DoubleDouble::square_root(omega(1e6).powi(2)).times(h).times(1e4);
        let difference = phase(1.0 / 60.0).minus(phase((1.0 + 1e-13) / 60.0)).0;
        assert!((difference.abs() / 1e-4 - 1.05).abs() <= 0.05, "{difference}");
    }

    #[test]
    #[ignore = "the long run of the test above"]
    fn phase_and_amplitude_agree_after_a_million_steps() {
        for (hertz, phase_error, amplitude_error) in phase_errors(1_000_000) {
            println!("{hertz} Hz: phase {phase_error:e} rad, amplitude {amplitude_error:e}");
            assert!(phase_error <= 2e-5 && amplitude_error <= 1e-9, "{hertz} Hz: {phase_error} {amplitude_error}");
        }
    }

    #[test]
    fn steady_force_converges_to_the_static_solution() {
        let mode = Oscillator::new(50.0, 0.3, 0.1).expect("valid parameters");
        let end = (0..1000).fold(ModeState::default(), |state, _| mode.advance(state, 2.0, 2.0));
        assert!((end.q - 2.0 / 50.0).abs() <= 1e-14 && end.v.abs() <= 1e-13, "{end:?}");
    }

    #[test]
    fn invalid_parameters_are_rejected() {
        for (eigenvalue, zeta, step) in [(-1.0, 0.0, 1.0), (f64::NAN, 0.0, 1.0), (1.0, -0.1, 1.0), (1.0, 0.1, 0.0)] {
            assert!(Oscillator::new(eigenvalue, zeta, step).is_err(), "{eigenvalue} {zeta} {step}");
        }
    }

    #[test]
    fn fixed_mode_does_not_move() {
        assert_eq!(Oscillator::new_fixed().advance(ModeState::default(), 5.0, 9.0), ModeState::default());
    }
}
