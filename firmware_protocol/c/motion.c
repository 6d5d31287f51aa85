#include "motion.h"

#include <math.h>
#include <string.h>

#define RAMP_GAIN_PER_MM 1.0 /* the motor follows a duty with 15 ms: crossover at 20 rad/s leaves 70 degrees */
#define RAMP_LEAD_MM 1.0     /* the ramp waits for a carriage that cannot follow */
#define DUTY_LIMIT 0.85
#define NO_LOAD_REV_S 2.5 /* 150 rpm at full duty, for the feed-forward */
#define TAPER_PER_S 8.0   /* speed over distance to the open end */
#define CREEP_MM_S 1.0    /* final approach to the switches */
#define BACK_OFF_MM 1.0
#define BACK_OFF_LIMIT_S 0.4 /* three times what it takes; without an encoder it must not go on towards closed */
#define SETTLE_S 0.05        /* braked at the switch before the drives go off: three motor time constants */
#define PROGRESS_MM 0.05
#define PATIENCE_S 0.3
#define DEAD_CURRENT_A 0.02 /* a connected motor draws ten times this at the duty that stands for no progress */
#define WRONG_WAY_MM 1.0     /* back, while homing drives the carriage open: its motor or its encoder is reversed */
#define TIME_LIMIT_S 8.0     /* the whole stroke at homing speed takes under 4 s */
#define SEARCH_SHARE 0.5     /* of the speed of opening, about that of homing, from which it brakes at a switch */
#define STROKE_MM 25.5       /* of a carriage, between its stops */
#define LEAST_SHARE 0.6      /* of the speed of opening: what the weakest motors reach on the lowest supply */
#define LATE_S 0.5           /* to turn round, to taper, to settle at the switch */

static double lesser(double a, double b)
{
    return b < a ? b : a;
}

static double greater(double a, double b)
{
    return b > a ? b : a;
}

/* -- one carriage -------------------------------------------------------------------------------------------------- */

static void ramp_start(struct tormag_ramp *ramp, double position_mm, double lead_mm)
{
    ramp->reference_mm = position_mm;
    ramp->full_speed_mm_s = NO_LOAD_REV_S * lead_mm;
}

/* Duty for the next tick at that signed speed. */
static double ramp_duty(struct tormag_ramp *ramp, double position_mm, double speed_mm_s)
{
    const double reference_mm = ramp->reference_mm + speed_mm_s * TORMAG_TICK_S;
    ramp->reference_mm = lesser(greater(reference_mm, position_mm - RAMP_LEAD_MM), position_mm + RAMP_LEAD_MM);
    const double duty =
        speed_mm_s / ramp->full_speed_mm_s + RAMP_GAIN_PER_MM * (ramp->reference_mm - position_mm);
    return lesser(greater(duty, -DUTY_LIMIT), DUTY_LIMIT);
}

static void opening_start(
    struct tormag_opening *opening,
    double time_s,
    const struct tormag_carriage *carriage,
    const struct tormag_drive_train *drive_train)
{
    memset(opening, 0, sizeof *opening);
    ramp_start(&opening->ramp, carriage->position_mm, drive_train->lead_mm);
    opening->stall_A = drive_train->stall_A;
    opening->progress_mm = carriage->position_mm;
    opening->progress_s = time_s;
    opening->outcome = TORMAG_MOVING;
}

/*
 * One tick towards the open end, at that speed at most.
 *
 * A carriage that comes no further has failed when its current says why: a stall, or no current at all. Standing still
 * at a travelling current is a dead encoder, and the motion goes on.
 */
static void opening_step(
    struct tormag_opening *opening, double time_s, const struct tormag_carriage *carriage, double speed_mm_s)
{
    if (opening->outcome == TORMAG_FAILED) {
        return;
    }
    if (carriage->at_open_end) {
        opening->duty = 0.0;
        if (!opening->arrived) {
            opening->arrived = true;
            opening->arrived_s = time_s;
        }
        opening->outcome = time_s - opening->arrived_s >= SETTLE_S ? TORMAG_DONE : TORMAG_MOVING;
        return;
    }
    opening->arrived = false;
    opening->outcome = TORMAG_MOVING;
    opening->duty = ramp_duty(&opening->ramp, carriage->position_mm, speed_mm_s);
    const double current_A = fabs(carriage->current_A);
    const bool travelling = DEAD_CURRENT_A < current_A && current_A < opening->stall_A;
    if (carriage->position_mm > opening->progress_mm + PROGRESS_MM) {
        opening->progress_mm = carriage->position_mm;
        opening->progress_s = time_s;
    } else if (time_s - opening->progress_s > PATIENCE_S && !travelling) {
        opening->duty = 0.0;
        opening->outcome = TORMAG_FAILED;
    }
}

/* -- both: retraction ---------------------------------------------------------------------------------------------- */

void tormag_retraction_start(
    struct tormag_retraction *retraction,
    double time_s,
    const struct tormag_carriage carriages[TORMAG_SIDES],
    const struct tormag_drive_train *drive_train,
    double speed_mm_s,
    bool tapered)
{
    retraction->deadline_s = time_s + TIME_LIMIT_S;
    retraction->late_s = time_s + STROKE_MM / (LEAST_SHARE * speed_mm_s) + LATE_S;
    retraction->speed_mm_s = speed_mm_s;
    retraction->tapered = tapered;
    for (int side = 0; side < TORMAG_SIDES; side++) {
        opening_start(&retraction->openings[side], time_s, &carriages[side], drive_train);
    }
}

bool tormag_retraction_blocked(const struct tormag_retraction *retraction)
{
    return retraction->openings[TORMAG_LEFT].outcome == TORMAG_FAILED
        || retraction->openings[TORMAG_RIGHT].outcome == TORMAG_FAILED;
}

bool tormag_retraction_late(const struct tormag_retraction *retraction, double time_s)
{
    return time_s > retraction->late_s;
}

enum tormag_outcome tormag_retraction_step(
    struct tormag_retraction *retraction, double time_s, const struct tormag_carriage carriages[TORMAG_SIDES])
{
    bool moving = false;
    bool failed = false;
    for (int side = 0; side < TORMAG_SIDES; side++) {
        struct tormag_opening *opening = &retraction->openings[side];
        double speed_mm_s = retraction->speed_mm_s;
        if (retraction->tapered) {
            /* beyond where its switch should have been the zero is wrong: it searches there */
            const double position_mm = carriages[side].position_mm;
            const double most_mm_s = position_mm < 0.0 ? speed_mm_s : SEARCH_SHARE * speed_mm_s;
            speed_mm_s = lesser(most_mm_s, CREEP_MM_S + TAPER_PER_S * fabs(position_mm));
        }
        opening_step(opening, time_s, &carriages[side], speed_mm_s);
        moving = moving || opening->outcome == TORMAG_MOVING;
        failed = failed || opening->outcome == TORMAG_FAILED;
    }
    if (moving && time_s < retraction->deadline_s) {
        return TORMAG_MOVING;
    }
    return moving || failed ? TORMAG_FAILED : TORMAG_DONE;
}

/* -- both: homing -------------------------------------------------------------------------------------------------- */

void tormag_homing_start(
    struct tormag_homing *homing,
    double time_s,
    const struct tormag_carriage carriages[TORMAG_SIDES],
    const struct tormag_drive_train *drive_train,
    double speed_mm_s)
{
    memset(homing, 0, sizeof *homing);
    homing->deadline_s = time_s + TIME_LIMIT_S;
    homing->speed_mm_s = speed_mm_s;
    homing->drive_train = *drive_train;
    homing->phase = TORMAG_HOMING_SEARCH;
    tormag_retraction_start(&homing->search, time_s, carriages, drive_train, speed_mm_s, false);
}

static enum tormag_outcome homing_search(
    struct tormag_homing *homing, double time_s, const struct tormag_carriage carriages[TORMAG_SIDES])
{
    for (int side = 0; side < TORMAG_SIDES && !homing->reversed; side++) {
        if (carriages[side].position_mm < homing->search.openings[side].progress_mm - WRONG_WAY_MM) {
            homing->reversed = true;
            homing->reversed_s = time_s;
        }
    }
    if (homing->reversed) {
        homing->duties[TORMAG_LEFT] = 0.0;
        homing->duties[TORMAG_RIGHT] = 0.0;
        return time_s - homing->reversed_s >= SETTLE_S ? TORMAG_REVERSED : TORMAG_MOVING;
    }
    const enum tormag_outcome outcome = tormag_retraction_step(&homing->search, time_s, carriages);
    for (int side = 0; side < TORMAG_SIDES; side++) {
        homing->duties[side] = homing->search.openings[side].duty;
    }
    return outcome;
}

static void homing_start_back_off(
    struct tormag_homing *homing, double time_s, const struct tormag_carriage carriages[TORMAG_SIDES])
{
    homing->phase = TORMAG_HOMING_BACK_OFF;
    homing->back_off_since_s = time_s;
    for (int side = 0; side < TORMAG_SIDES; side++) {
        homing->starts_mm[side] = carriages[side].position_mm;
        ramp_start(&homing->ramps[side], carriages[side].position_mm, homing->drive_train.lead_mm);
    }
}

static enum tormag_outcome homing_back_off(
    struct tormag_homing *homing, double time_s, const struct tormag_carriage carriages[TORMAG_SIDES])
{
    if (time_s - homing->back_off_since_s > BACK_OFF_LIMIT_S) {
        return TORMAG_FAILED;
    }
    bool clear = true;
    for (int side = 0; side < TORMAG_SIDES; side++) {
        const double position_mm = carriages[side].position_mm;
        const bool side_clear = position_mm <= homing->starts_mm[side] - BACK_OFF_MM && !carriages[side].at_open_end;
        homing->duties[side] = side_clear ? 0.0 : ramp_duty(&homing->ramps[side], position_mm, -homing->speed_mm_s);
        clear = clear && homing->duties[side] == 0.0;
    }
    if (clear) {
        homing->phase = TORMAG_HOMING_CREEP;
        tormag_retraction_start(&homing->search, time_s, carriages, &homing->drive_train, CREEP_MM_S, false);
    }
    return TORMAG_MOVING;
}

static enum tormag_outcome homing_creep(
    struct tormag_homing *homing, double time_s, const struct tormag_carriage carriages[TORMAG_SIDES])
{
    for (int side = 0; side < TORMAG_SIDES; side++) {
        if (carriages[side].at_open_end && !homing->found[side]) {
            homing->found[side] = true;
            homing->zeros_mm[side] = carriages[side].position_mm;
        }
    }
    return homing_search(homing, time_s, carriages);
}

enum tormag_outcome tormag_homing_step(
    struct tormag_homing *homing, double time_s, const struct tormag_carriage carriages[TORMAG_SIDES])
{
    if (time_s >= homing->deadline_s) {
        return TORMAG_FAILED;
    }
    switch (homing->phase) {
    case TORMAG_HOMING_BACK_OFF:
        return homing_back_off(homing, time_s, carriages);
    case TORMAG_HOMING_CREEP:
        return homing_creep(homing, time_s, carriages);
    case TORMAG_HOMING_SEARCH:
    default: {
        const enum tormag_outcome outcome = homing_search(homing, time_s, carriages);
        if (outcome != TORMAG_DONE) {
            return outcome;
        }
        homing_start_back_off(homing, time_s, carriages);
        return TORMAG_MOVING;
    }
    }
}
