//! Every drop, reject, overflow and fault has a counter and a name. Counters never wrap and never
//! allocate; the report lists those that are not zero.

pub use stipple_drivers::counters::Counter;

stipple_drivers::counters! {
    pub struct Counters of Counter, read by Counter::get;
    /// Frames replaced in the mailbox before the tracker took them.
    frames_overwritten,
    /// Frames whose stamp the table of poses does not cover.
    frames_without_pose,
    /// Frames that could not be read.
    frames_unreadable,
    /// Frames that never came, by the intervals of their stamps.
    frames_missing,
    /// Frames refused: stamped no later than the last.
    frames_not_newer,
    /// Frames refused: stamped more than a second ahead of their arrival.
    frames_timestamp_jump,
    /// Frames refused: every camera gave the picture before once more.
    frames_frozen,
    /// Pictures made black: a camera gave the one before once more, and another went on.
    images_frozen,
    /// Frames of which a camera saw nothing: covered, its light out, away or hanging.
    frames_blank,
    /// Frames tracked though no inertial sample at their stamp came in time.
    frames_without_imu,
    /// Times the cameras were lost, and times they fell silent; how long they were away altogether, ms.
    camera_lost,
    camera_silent,
    camera_away_ms,
    /// Times that one camera was lost while the others went on, and how long it was away altogether, ms.
    one_camera_lost,
    one_camera_away_ms,
    /// Inertial samples that did not fit between two frames.
    imu_overflow,
    /// Inertial samples that never came, by their stamps; those refused as not newer than the last, and as stamped too far
    /// ahead of their arrival.
    imu_missing,
    imu_not_newer,
    imu_timestamp_jump,
    /// Samples of a unit that repeats itself: alike to the last bit for a tenth of a second.
    imu_frozen,
    /// Samples with an axis at the end of its range, as the source says.
    imu_saturated,
    /// Times that the inertial unit was lost, and times that it fell silent; how long it was away altogether, ms.
    imu_lost,
    imu_silent,
    imu_away_ms,
    /// Readings of a barometer that did not fit between two frames; times that it was lost, and times that it fell silent; how
    /// long it was away altogether, ms.
    aid_overflow,
    aid_lost,
    aid_silent,
    aid_away_ms,
    /// Inertial samples refused: not finite, or not newer than the last.
    imu_rejected,
    /// Inertial samples of which one axis was no motion (a flipped bit), and was put between its neighbours.
    imu_repaired,
    /// Keyframes that loop closure skipped, as it was busy with those before.
    loops_busy,
    /// Tracks beyond TRACKS.
    tracks_full,
    /// Landmarks beyond LANDMARKS.
    landmarks_full,
    /// Observations dropped as outliers after optimisation.
    outliers,
    /// Optimisations whose step was not finite.
    solver_failures,
    /// Keyframes offered while every slot was taken.
    keyframes_rejected,
    /// Keyframes not offered to the map, since a camera saw nothing.
    keyframes_blank,
    /// Keyframes refused by the mapper, as their pose is not finite.
    keyframes_not_finite,
    /// Pose corrections that found their queue full.
    corrections_full,
    /// Joins of epochs that the mapper could not follow.
    epochs_kept_apart,
    /// Keyframes dropped because the mapper had no room for them.
    keyframe_store_full,
    /// Anchors not made because there are as many blocks as there may be.
    blocks_full,
    /// Keyframes that would have been anchors if what they show were not on disk.
    anchors_on_disk,
    /// Blocks and images that came from the disk, and blocks that left the pool for it.
    blocks_paged_in,
    blocks_paged_out,
    images_paged_in,
    /// Blocks and images that could not be read back.
    blocks_lost,
    keyframes_lost,
    /// What the store of the map was given, wrote and read, bytes; records that were damaged; records that it refused as it
    /// was full; writes that failed.
    store_bytes_put,
    store_bytes_written,
    store_bytes_read,
    store_records_damaged,
    store_refused_full,
    store_write_errors,
    /// Snapshots of what the store does not have yet (`map/latest`) that could not be written; one where there is no place for any.
    snapshot_errors,
    /// Keyframes whose pair was not matched, as the map shows their view.
    views_covered,
    /// Anchors not made because their pair could not be matched.
    depth_failures,
    /// Anchors not made because their pair showed no depth: a camera is covered, or nothing has detail.
    depth_absent,
    /// Seeds that did not fit into the pool.
    splats_full,
    /// Seeds refused because their cell was occupied.
    seeds_occupied,
    /// Seeds of which the hash table could not say whether their cell is held.
    occupancy_full,
    /// Gaussians removed for being faint, huge or not finite.
    splats_pruned,
    /// Gaussians removed from a full pool for being the least important.
    splats_evicted,
    /// Gaussians added where an anchor's picture was wrong.
    splats_densified,
    /// Anchors whose view was covered, but badly.
    anchors_for_error,
    /// Anchors whose Gaussians were moved after a correction.
    blocks_moved,
    /// Rectification was made anew: the cameras sit elsewhere on the body than before.
    rectified_anew,
    /// Steps not taken because their (Gaussian, tile) list overflowed; pictures and steps drawn coarser so that it did not.
    intersections_overflow,
    views_coarsened,
    /// Training steps that drew and compared their view at half the size (`map.half_size_steps`).
    steps_at_half_size,
    /// The most places for (Gaussian, tile) pairs that a picture or a step needed. Where views_coarsened is zero, budget.intersections need
    /// not be larger.
    intersections_most,
    /// Gaussians left out of a step because a parameter was not finite.
    splats_not_finite,
    /// Gaussians skipped by the optimiser because a gradient was not finite.
    gradients_rejected,
    /// Lines that standard error did not take: it is closed, or nobody reads.
    lines_lost,
    /// Times that a thread gave no sign of life for longer than it may.
    threads_silent,
    /// Times that the mapper's process was started again.
    map_restarts,
    /// GPU submissions that failed.
    gpu_failures,
}
