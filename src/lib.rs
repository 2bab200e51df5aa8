//! Stipple: live stereo-inertial odometry and a 3D Gaussian map, in fixed memory, on small GPUs.
//!
//! Sensors push time-stamped samples into bounded queues; a sans-IO estimator turns them into states and keyframes; a mapper
//! spends a fixed GPU budget on them; every byte is bought at boot from a board file.
//!
//! ```text
//! frames -> mailbox(newest) -> frontend -Tracks-> vio -Keyframe(offer)-> map.step(deadline)
//! imu    -> queue -----------------------------------^      `-> loops -map_from_odom, corrections-^
//! ```
//!
//! Rooms: `math`, `mem`, `limits`, `config` and `counters` are seen by all. `frontend` and `vio` see the vocabulary of
//! `stipple-drivers`, `vio` also the frontend's `Tracks`; `loops` sees `frontend`; `stereo` and `map` see `gpu`, `map` also `stereo` and `store`; `output` sees what it
//! writes of `map` and `vio`, and `publish` what it tells of `vio`. `run` sees all of these, `commands` see all, and nobody sees `commands`. tests/tidy checks it.
//!
//! # Glossary
//!
//! | term | meaning |
//! |---|---|
//! | anchor | a keyframe that seeded Gaussians: its view was not reconstructed; it owns a contiguous block of them |
//! | archive | what the mapper knows of the map on disk, and what it brings into memory (`map::archive`) |
//! | block | the Gaussians of one anchor: what goes to disk and comes back whole |
//! | board | a computer with its sensors, as its board file describes it |
//! | body | the frame of the inertial unit; poses are `world_from_body`, world z up |
//! | burst | training steps that follow a new anchor, every other on its own view |
//! | closure | a loop edge of the pose graph: a place that was recognised, and from where it is seen (`loops`) |
//! | coverage | the part of a view that the map shows, and shows well |
//! | deviation | standard deviation, wherever an error is stated |
//! | exposure | gain and offset that take a rendering to what a camera recorded |
//! | frame | the images of all cameras at one mid-exposure instant |
//! | gate | what judges and repairs samples and frames before anybody uses them (`run::gate`) |
//! | generation | the number of a record's version in the store: a newer one replaces an older |
//! | held out | a keyframe that is never trained on, only evaluated |
//! | horizon | how far a keyframe sees, in a few cells: which blocks it sees is told by it (`map::horizon`) |
//! | increment | inertial samples between two frames, integrated (preintegration) |
//! | keyframe | a frame kept in the estimator's window as a pose, and offered to the map |
//! | landmark | a point of the estimator: direction and inverse distance in its host keyframe |
//! | level frame | the frame of the body turned upright: loops are measured between these, in position and yaw |
//! | lockstep | a deterministic replay: a stated number of training steps a frame |
//! | map frame | where loops agree; `odom` is the estimator's, which drifts and does not jump; `map_from_odom` leads from one to the other |
//! | mailbox | where the newest frame and all samples wait for tracking |
//! | marginalization | taking old frames out of the window; what they knew stays as the prior |
//! | packet | a frame on its way through tracking, with its inertial samples and results |
//! | record | what `store` keeps of one block or keyframe: a header and a payload, in a segment |
//! | seal | the moment after which our threads allocate nothing |
//! | place | room for a keyframe's images in memory |
//! | pool | the fixed number of places for Gaussians (*splats* in the budget and in kernels) |
//! | segment | a file of the store, of fixed size, that is appended to until it is full |
//! | seed | a new Gaussian at a pixel of an anchor, at its stereo depth |
//! | slot | a place in a pool of fixed size |
//! | step | one training step: a view rendered, compared, and the Gaussians moved |
//! | tombstone | a record that says that its key was removed |
//! | track | a point that the frontend follows from frame to frame, by id |

// The world of points for unit tests (tests/bench/world.rs) names this crate as integration tests do.
#[cfg(test)]
extern crate self as stipple;
#[cfg(test)]
#[path = "../tests/bench/world.rs"]
pub mod world;

pub mod commands;
pub mod mem;

cfg_if::cfg_if! {
    if #[cfg(feature = "instruments")] {
        #[doc(hidden)]
        pub mod config;
        #[doc(hidden)]
        pub mod counters;
        #[doc(hidden)]
        pub mod frontend;
        #[doc(hidden)]
        pub mod gpu;
        #[doc(hidden)]
        pub mod limits;
        #[doc(hidden)]
        pub mod loops;
        #[doc(hidden)]
        pub mod map;
        #[doc(hidden)]
        pub mod math;
        #[doc(hidden)]
        pub mod output;
        #[doc(hidden)]
        pub mod publish;
        #[doc(hidden)]
        pub mod run;
        #[doc(hidden)]
        pub mod stereo;
        #[doc(hidden)]
        pub mod store;
        #[doc(hidden)]
        pub mod vio;
    } else {
        mod config;
        mod counters;
        mod frontend;
        mod gpu;
        mod limits;
        #[allow(dead_code)] // the program does not use all that the instruments and tests do
        mod loops;
        mod map;
        mod math;
        mod output;
        mod publish;
        mod run;
        mod stereo;
        #[allow(dead_code)] // the program does not use all that the instruments and tests do
        mod store;
        mod vio;
    }
}
