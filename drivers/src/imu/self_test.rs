//! A die's test of itself: its proof masses are pushed by a known force, and what they answer is compared with what
//! the data sheet, or the factory's measurement of this very die, demands. The board is to stand still meanwhile.

use super::bus::Bus;
use super::chips::{self, Asked, FactoryTest, Push, SelfTest, Step, Which};
use super::die::{Die, Trouble};
use crate::types::Span;

/// Samples whose mean is taken, as InvenSense's procedure has it; 1 ms apart.
const SAMPLES: usize = 200;
/// How long a die that tests itself may take: Bosch's own driver gives it half a second.
const ASKED_MS: u32 = 500;

const AXES: [[&str; 3]; 2] =
    [["accelerometer x", "accelerometer y", "accelerometer z"], ["gyro x", "gyro y", "gyro z"]];

fn axis(of: Which, i: usize) -> &'static str {
    AXES[usize::from(of == Which::Gyro)][i]
}

/// Leaves the die in some state: it is to be started after.
pub fn self_test<B: Bus>(die: &mut Die<B>) -> Result<(), Trouble> {
    die.wake()?;
    die.chip.self_tests.iter().try_for_each(|test| match test {
        SelfTest::Push(test) => push(die, test),
        SelfTest::Factory(test) => factory(die, test),
        SelfTest::Asked(test) => asked(die, test),
    })
}

fn asked<B: Bus>(die: &mut Die<B>, test: &Asked) -> Result<(), Trouble> {
    die.run(test.prepare)?;
    die.write(test.trigger.0, test.trigger.1)?;
    die.expect(test.answer, test.done, test.done, ASKED_MS)?;
    let answer = die.read_byte(test.answer)?;
    if answer & test.verdict == test.good {
        Ok(())
    } else {
        let which = if test.of == Which::Accel { "accelerometer" } else { "gyro" };
        Err(Trouble::SelfTest(which, f64::from(answer)))
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

fn factory<B: Bus>(die: &mut Die<B>, test: &FactoryTest) -> Result<(), Trouble> {
    let settle = [Step::WaitUs(test.settle_us)];
    die.run(test.prepare)?;
    die.run(&settle)?;
    let off = mean(die, test.of)?;
    die.run(test.on)?;
    die.run(&settle)?;
    let on = mean(die, test.of)?;
    die.run(test.off)?;
    die.run(&settle)?;
    let mut codes = [0; 3];
    for (code, register) in codes.iter_mut().zip(test.codes) {
        *code = die.read_byte(register)?;
    }
    // Code 0: the factory left no measurement, and the push itself must do.
    let coded = codes.iter().all(|code| *code != 0);
    for i in 0..3 {
        let push = (on[i] - off[i]).abs();
        let (answer, (least, most)) = if coded {
            (push / (test.base * 1.01f64.powi(i32::from(codes[i]) - 1)), test.ratio)
        } else {
            (push, test.uncoded)
        };
        if !(least..=most).contains(&answer) {
            return Err(Trouble::SelfTest(axis(test.of, i), answer));
        }
    }
    Ok(())
}
