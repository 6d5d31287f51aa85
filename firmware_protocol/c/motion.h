/*
 * The device's own motions: opening at a bounded speed, and homing. Positive is opening.
 *
 * Both move each carriage along a position ramp and let the drive duty follow it: the ramp's speed as feed-forward, the
 * distance to the ramp as the integral part. The duty is bounded too, and with it, through the motor's back-EMF, the
 * speed of a carriage whose encoder is dead.
 *
 * Times are in seconds on the device's clock and never fall; a step is one tick of TORMAG_TICK_S.
 */
#ifndef TORMAG_MOTION_H
#define TORMAG_MOTION_H

#include <stdbool.h>

#define TORMAG_TICK_S 1e-3

enum tormag_side { TORMAG_LEFT = 0, TORMAG_RIGHT = 1, TORMAG_SIDES = 2 };

enum tormag_outcome { TORMAG_MOVING = 0, TORMAG_DONE, TORMAG_FAILED, TORMAG_REVERSED };

/* What is known of one carriage: encoder position, its open switch, its motor's current. */
struct tormag_carriage {
    double position_mm;
    bool at_open_end;
    double current_A;
};

/* What the motions need to know of the hardware. */
struct tormag_drive_train {
    double lead_mm; /* carriage travel per turn of the screw */
    double stall_A; /* motor current, in magnitude, that says a carriage is held */
};

/* Moves one carriage at a bounded speed, by way of a position that runs ahead of it. */
struct tormag_ramp {
    double reference_mm;
    double full_speed_mm_s;
};

/* Brings one carriage to its open switch and brakes it there. */
struct tormag_opening {
    struct tormag_ramp ramp;
    double stall_A;
    double progress_mm;
    double progress_s;
    bool arrived;
    double arrived_s;
    double duty;
    enum tormag_outcome outcome;
};

/* Opens the gap: both carriages to their switches, each as far as it comes. */
struct tormag_retraction {
    double deadline_s;
    double late_s; /* the time of the whole stroke is over then: it says so, and goes on */
    double speed_mm_s;
    bool tapered;
    struct tormag_opening openings[TORMAG_SIDES];
};

enum tormag_homing_phase { TORMAG_HOMING_SEARCH = 0, TORMAG_HOMING_BACK_OFF, TORMAG_HOMING_CREEP };

/* Finds the open switches twice: at speed, then, after backing off, creeping, so that the zero repeats. */
struct tormag_homing {
    double deadline_s;
    double speed_mm_s;
    struct tormag_drive_train drive_train;
    enum tormag_homing_phase phase;
    struct tormag_retraction search;
    struct tormag_ramp ramps[TORMAG_SIDES];
    double starts_mm[TORMAG_SIDES];
    double back_off_since_s;
    bool reversed; /* a carriage has gone back; both are braked before the drives go off */
    double reversed_s;
    bool found[TORMAG_SIDES];
    double zeros_mm[TORMAG_SIDES]; /* encoder positions of the two switches once the outcome is TORMAG_DONE */
    double duties[TORMAG_SIDES];
};

/*
 * Starts to open at `speed_mm_s` at most. `tapered` needs a valid zero: the speed then falls towards the open end;
 * without it the speed stays, and should be low.
 */
void tormag_retraction_start(
    struct tormag_retraction *retraction,
    double time_s,
    const struct tormag_carriage carriages[TORMAG_SIDES],
    const struct tormag_drive_train *drive_train,
    double speed_mm_s,
    bool tapered);

/*
 * One tick; the duties are then in openings[].duty. FAILED when a carriage could not be brought to its switch and
 * neither moves any more, or the time is up.
 */
enum tormag_outcome tormag_retraction_step(
    struct tormag_retraction *retraction, double time_s, const struct tormag_carriage carriages[TORMAG_SIDES]);

/* Whether a carriage has been given up; its screw springs back from the stall. */
bool tormag_retraction_blocked(const struct tormag_retraction *retraction);

/* Whether it has taken longer than the whole stroke takes a device that can open; it goes on, for it may arrive. */
bool tormag_retraction_late(const struct tormag_retraction *retraction, double time_s);

/* Starts to look for the switches, wherever the carriages are. */
void tormag_homing_start(
    struct tormag_homing *homing,
    double time_s,
    const struct tormag_carriage carriages[TORMAG_SIDES],
    const struct tormag_drive_train *drive_train,
    double speed_mm_s);

/* One tick: outward, back off, creep outward. REVERSED when a carriage has gone back, and was braked. */
enum tormag_outcome tormag_homing_step(
    struct tormag_homing *homing, double time_s, const struct tormag_carriage carriages[TORMAG_SIDES]);

#endif
