//! Tests of the simulator as a whole, by subject.

mod another_day;
mod hardships;
mod movement;
mod picture;
mod source;
mod truth;
mod wheels;

use super::{Scenario, Simulator, SimulatorConfig};
use crate::camera::Pacing;
use crate::image::GreyImage;

/// A small, coarse and therefore quick version of a configuration.
fn quick(mut config: SimulatorConfig) -> SimulatorConfig {
    (config.width, config.height) = (320, 240);
    config.texel_mm = 12.0;
    config
}

fn simulator(config: &SimulatorConfig) -> Simulator {
    Simulator::new(config, Pacing::LockStep).expect("a valid configuration")
}

fn picture(simulator: &mut Simulator, sequence: u64) -> GreyImage {
    let mut picture = GreyImage::default();
    simulator.render(sequence, &mut picture);
    picture
}

fn mean(picture: &GreyImage) -> f64 {
    picture.data.iter().map(|&v| f64::from(v)).sum::<f64>() / picture.data.len() as f64
}
