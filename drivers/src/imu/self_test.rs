//! A die's test of itself: its proof masses are pushed by a known force, and what they answer is compared with what
//! the data sheet, or the factory's measurement of this very die, demands. The board is to stand still meanwhile.

use super::bus::Bus;
use super::chips::{self, FactoryTest, Push, SelfTest, Step, Which};
use super::die::{Die, Trouble};
use crate::types::Span;

/// Samples whose mean is taken, as InvenSense's procedure has it; 1 ms apart.
const SAMPLES: usize = 200;

const AXES: [[&str; 3]; 2] =
    [["accelerometer x", "accelerometer y", "accelerometer z"], ["gyro x", "gyro y", "gyro z"]];

fn axis(of: Which, i: usize) -> &'static str {
    AXES[usize::from(of == Which::Gyro)][i]
}

/// Leaves the die in some state: it is to be started after.
pub fn self_test<B: Bus>(die: &mut Die<B>) -> Result<(), Trouble> {
    die.wake()?;
    match &die.chip.self_test {
        SelfTest::None => Ok(()),
        SelfTest::Push(tests) => tests.iter().try_for_each(|test| push(die, test)),
        SelfTest::Factory { tests, settle_us } => tests.iter().try_for_each(|test| factory(die, test, *settle_us)),
        SelfTest::Asked { register, trigger, ready, failed } => {
            die.write(*register, *trigger)?;
            die.expect(*register, *ready, *ready, 100)?;
            let answer = die.read_byte(*register)?;
            if answer & failed == 0 {
                Ok(())
            } else {
                Err(Trouble::SelfTest("gyro", f64::from(answer)))
            }
        }
    }
}

fn sense(die: &chips::Die, of: Which) -> &chips::Sense {
    let sense = if of == Which::Accel { die.accel.as_ref() } else { die.gyro.as_ref() };
    sense.expect("a die's tests are of sensors it has")
}

fn mean<B: Bus>(die: &mut Die<B>, of: Which) -> Result<[f64; 3], Trouble> {
    let mut sum = [0.0; 3];
    for _ in 0..SAMPLES {
        let raw = die.newest(sense(die.chip, of))?;
        (0..3).for_each(|i| sum[i] += f64::from(raw[i]));
        die.bus.sleep(Span(1_000_000));
    }
    Ok(sum.map(|s| s / SAMPLES as f64))
}

fn push<B: Bus>(die: &mut Die<B>, test: &Push) -> Result<(), Trouble> {
    die.run(test.prepare)?;
    die.run(test.on)?;
    let on = mean(die, test.of)?;
    die.run(test.off)?;
    let off = mean(die, test.of)?;
    for i in 0..3 {
        // Data sheets give the size; the sign depends on how the masses lie.
        let answer = (on[i] - off[i]).abs() * test.per_lsb;
        let (least, most) = test.within[i];
        if !(least..=most).contains(&answer) {
            return Err(Trouble::SelfTest(axis(test.of, i), answer));
        }
    }
    Ok(())
}

fn factory<B: Bus>(die: &mut Die<B>, test: &FactoryTest, settle_us: u32) -> Result<(), Trouble> {
    die.run(test.prepare)?;
    die.run(&[Step::WaitUs(settle_us)])?;
    let off = mean(die, test.of)?;
    die.run(test.on)?;
    die.run(&[Step::WaitUs(settle_us)])?;
    let on = mean(die, test.of)?;
    die.run(test.off)?;
    die.run(&[Step::WaitUs(settle_us)])?;
    for i in 0..3 {
        let code = die.read_byte(test.codes[i])?;
        // Code 0: the factory left no measurement, and there is nothing to compare with.
        if code == 0 {
            continue;
        }
        let ratio = (on[i] - off[i]).abs() / (test.base * 1.01f64.powi(i32::from(code) - 1));
        if !(test.ratio.0..=test.ratio.1).contains(&ratio) {
            return Err(Trouble::SelfTest(axis(test.of, i), ratio));
        }
    }
    Ok(())
}
