//! The fuzzer of cubic polynomials of internal forces (`.cub`), which the physics process reads.

#![no_main]

#[path = "../libfuzzer.rs"]
mod libfuzzer;

use modalcast_dynamics::cubic::ReducedForce;

/// Forces of one coordinate: one linear, one quadratic and one cubic monomial.
pub(crate) fn seeds(_target: &str) -> Vec<Vec<u8>> {
    let counts: Vec<u8> = [1_i32; 4].iter().flat_map(|count| count.to_le_bytes()).collect();
    let coefficients: Vec<u8> = [4.0_f64, 0.5, 1.0].iter().flat_map(|number| number.to_le_bytes()).collect();
    vec![[counts, coefficients].concat()]
}

pub(crate) fn run(input: &[u8]) {
    ReducedForce::parse(input).ok();
}
