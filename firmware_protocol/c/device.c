#include "device.h"

#include <math.h>
#include <string.h>

#define STATUS_TICKS 20u /* 50 Hz */
#define COMMAND_TIMEOUT_S 0.05
#define OVERCURRENT_S 0.15 /* a reversal at full speed takes about 50 ms of high current */
#define MAX_SKEW_MM 2.0
#define MAX_SLIP_MM 0.2
#define COASTING_S 0.1 /* a carriage may go on this long before its motion counts as uncommanded */
#define MIN_SUPPLY_V 9.0
#define MAX_SUPPLY_V 15.0
#define MAX_TEMPERATURE_C 60.0
#define NONE_YET (-1)

/* The generator's names, cut to what is said here. */
enum {
    IDLE = TORMAG_STATUS_MODE_IDLE_CHOICE,
    RUN = TORMAG_STATUS_MODE_RUN_CHOICE,
    HOMING = TORMAG_STATUS_MODE_HOMING_CHOICE,
    RETRACTING = TORMAG_STATUS_MODE_RETRACTING_CHOICE,
    LATCHED = TORMAG_STATUS_MODE_LATCHED_CHOICE
};

enum {
    COMMAND_TIMEOUT = TORMAG_STATUS_FAULTS_COMMAND_TIMEOUT_CHOICE,
    UNCOMMANDED_MOTION = TORMAG_STATUS_FAULTS_UNCOMMANDED_MOTION_CHOICE,
    OVERCURRENT = TORMAG_STATUS_FAULTS_OVERCURRENT_CHOICE,
    END_STOP = TORMAG_STATUS_FAULTS_END_STOP_CHOICE,
    HOMING_FAILED = TORMAG_STATUS_FAULTS_HOMING_FAILED_CHOICE,
    SUPPLY = TORMAG_STATUS_FAULTS_SUPPLY_CHOICE,
    TEMPERATURE = TORMAG_STATUS_FAULTS_TEMPERATURE_CHOICE,
    SCHEMA_MISMATCH = TORMAG_STATUS_FAULTS_SCHEMA_MISMATCH_CHOICE,
    SKEW = TORMAG_STATUS_FAULTS_SKEW_CHOICE,
    RETRACT_FAILED = TORMAG_STATUS_FAULTS_RETRACT_FAILED_CHOICE
};

static const uint8_t OPEN_SWITCH[TORMAG_SIDES] = {
    TORMAG_STATUS_SWITCHES_LEFT_OPEN_CHOICE, TORMAG_STATUS_SWITCHES_RIGHT_OPEN_CHOICE};

#define CLOSED_SWITCHES (TORMAG_STATUS_SWITCHES_LEFT_CLOSED_CHOICE | TORMAG_STATUS_SWITCHES_RIGHT_CLOSED_CHOICE)

void tormag_device_init(struct tormag_device *device, const struct tormag_device_parameters *parameters)
{
    memset(device, 0, sizeof *device);
    device->mode = IDLE;
    device->parameters = *parameters;
    device->may_run = true;
    device->drive_counter = NONE_YET;
}

/* -- what is measured ---------------------------------------------------------------------------------------------- */

static bool at_open_end(const struct tormag_sensors *sensors, int side)
{
    return (sensors->switches & OPEN_SWITCH[side]) != 0;
}

double tormag_device_position_mm(
    const struct tormag_device *device, const struct tormag_sensors *sensors, enum tormag_side side)
{
    return (double)sensors->counts[side] * device->parameters.mm_per_count - device->zeros_mm[side];
}

static void read_carriages(
    const struct tormag_device *device,
    const struct tormag_sensors *sensors,
    struct tormag_carriage carriages[TORMAG_SIDES])
{
    for (int side = 0; side < TORMAG_SIDES; side++) {
        carriages[side].position_mm = tormag_device_position_mm(device, sensors, (enum tormag_side)side);
        carriages[side].at_open_end = at_open_end(sensors, side);
        carriages[side].current_A = sensors->current_A[side];
    }
}

/* A carriage at its open switch is not driven on into the stop. */
static void bound_output(struct tormag_output *output, const struct tormag_sensors *sensors)
{
    for (int side = 0; side < TORMAG_SIDES; side++) {
        if (at_open_end(sensors, side) && output->duty[side] > 0.0) {
            output->duty[side] = 0.0;
        }
    }
}

/* Faults whose cause is there now, whatever the device does. */
static unsigned int lasting_causes(const struct tormag_sensors *sensors)
{
    unsigned int causes = 0u;
    if (!(MIN_SUPPLY_V <= sensors->supply_V && sensors->supply_V <= MAX_SUPPLY_V)) {
        causes |= SUPPLY;
    }
    if (sensors->temperature_C > MAX_TEMPERATURE_C) {
        causes |= TEMPERATURE;
    }
    return causes;
}

/* OVERCURRENT once a motor's current has been over the level without a break for too long. */
static unsigned int overcurrent(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    bool too_long = false;
    for (int side = 0; side < TORMAG_SIDES; side++) {
        if (fabs(sensors->current_A[side]) < device->parameters.drive_train.stall_A) {
            device->calm_s[side] = time_s;
        }
        too_long = too_long || time_s - device->calm_s[side] > OVERCURRENT_S;
    }
    return too_long ? OVERCURRENT : 0u;
}

static void reset_overcurrent(struct tormag_device *device, double time_s)
{
    for (int side = 0; side < TORMAG_SIDES; side++) {
        device->calm_s[side] = time_s;
    }
}

/* Whether a carriage has moved from where it rested; while opening, inward from where it had come to. */
static bool slipped(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    if (time_s - device->watch_since_s < COASTING_S) {
        return false;
    }
    int64_t farthest = 0;
    for (int side = 0; side < TORMAG_SIDES; side++) {
        const int32_t counts = sensors->counts[side];
        if (!device->watching || (device->mode == RETRACTING && counts > device->watch_counts[side])) {
            device->watch_counts[side] = counts;
        }
        const int64_t distance = (int64_t)counts - device->watch_counts[side];
        const int64_t magnitude = distance < 0 ? -distance : distance;
        farthest = magnitude > farthest ? magnitude : farthest;
    }
    device->watching = true;
    return (double)farthest * device->parameters.mm_per_count > MAX_SLIP_MM;
}

static void restart_slip_watch(struct tormag_device *device, double time_s)
{
    device->watch_since_s = time_s;
    device->watching = false;
}

/* -- transitions --------------------------------------------------------------------------------------------------- */

/* Drives off; a latched fault also takes away the trust in the zero. */
static void rest(struct tormag_device *device, double time_s, uint8_t mode)
{
    device->mode = mode;
    device->output.duty[TORMAG_LEFT] = 0.0;
    device->output.duty[TORMAG_RIGHT] = 0.0;
    device->output.enabled = false;
    restart_slip_watch(device, time_s);
    if (mode == LATCHED) {
        device->homed = false;
    }
}

static void retract(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    const struct tormag_device_parameters *parameters = &device->parameters;
    struct tormag_carriage carriages[TORMAG_SIDES];
    read_carriages(device, sensors, carriages);
    if (device->mode == RUN) {
        device->may_run = false;
    }
    device->mode = RETRACTING;
    restart_slip_watch(device, time_s);
    tormag_retraction_start(
        &device->motion.retraction,
        time_s,
        carriages,
        &parameters->drive_train,
        device->homed ? parameters->retract_mm_s : parameters->homing_mm_s,
        device->homed);
}

static bool motors_off(const struct tormag_device *device)
{
    return device->mode == IDLE || device->mode == LATCHED;
}

/* Latches a fault and opens the gap; drives that are off stay off, unless the carriages move by themselves. */
static void fail(struct tormag_device *device, double time_s, unsigned int fault, const struct tormag_sensors *sensors)
{
    device->faults = (uint16_t)(device->faults | fault);
    if (motors_off(device) && (fault & UNCOMMANDED_MOTION) == 0u) {
        rest(device, time_s, LATCHED);
    } else if (device->mode != RETRACTING) {
        retract(device, time_s, sensors);
    }
}

/* -- messages ------------------------------------------------------------------------------------------------------ */

/* A Drive with a new counter is answered in every mode, so that a host can always measure. */
static enum tormag_answer receive_drive(
    struct tormag_device *device,
    double time_s,
    const struct tormag_drive_t *drive,
    const struct tormag_sensors *sensors)
{
    if (drive->counter == device->drive_counter) {
        return TORMAG_ANSWER_NONE;
    }
    device->drive_counter = drive->counter;
    if (drive->mode == TORMAG_DRIVE_MODE_OFF_CHOICE) {
        if (device->mode == RUN) {
            retract(device, time_s, sensors);
        }
        /* a host that was put off RUN has to let go once before it gets there again */
        device->may_run = true;
        return TORMAG_ANSWER_MEASUREMENT;
    }
    if (device->mode == IDLE && device->may_run && device->homed && device->compatible && device->faults == 0u) {
        device->mode = RUN;
        reset_overcurrent(device, time_s);
    }
    if (device->mode == RUN) {
        device->drive_s = time_s;
        device->output.duty[TORMAG_LEFT] = drive->left_duty * TORMAG_DRIVE_LEFT_DUTY_SCALE;
        device->output.duty[TORMAG_RIGHT] = drive->right_duty * TORMAG_DRIVE_RIGHT_DUTY_SCALE;
        device->output.enabled = true;
        bound_output(&device->output, sensors);
    }
    return TORMAG_ANSWER_MEASUREMENT;
}

static enum tormag_answer receive_hello(
    struct tormag_device *device,
    double time_s,
    const struct tormag_hello_t *hello,
    const struct tormag_sensors *sensors)
{
    /* accepted whatever it was before, so that a new host starts from a known nonce */
    device->nonce = hello->nonce;
    device->compatible =
        hello->schema_hash == TORMAG_SCHEMA_HASH && hello->protocol_version == TORMAG_PROTOCOL_VERSION;
    if (!device->compatible) {
        fail(device, time_s, SCHEMA_MISMATCH, sensors);
    }
    return TORMAG_ANSWER_IDENTITY;
}

/* These three return whether the command was accepted; only an accepted one is acknowledged in Status. */

static bool obey_retract(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    if (device->mode == LATCHED) {
        return false;
    }
    if (device->mode != RETRACTING) {
        retract(device, time_s, sensors);
    }
    return true;
}

static bool obey_home(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    if (device->mode != IDLE) {
        return false;
    }
    struct tormag_carriage carriages[TORMAG_SIDES];
    read_carriages(device, sensors, carriages);
    device->mode = HOMING;
    device->homed = false;
    reset_overcurrent(device, time_s);
    tormag_homing_start(
        &device->motion.homing, time_s, carriages, &device->parameters.drive_train, device->parameters.homing_mm_s);
    return true;
}

static bool obey_clear(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    const bool mismatch = (device->faults & SCHEMA_MISMATCH) != 0 && !device->compatible;
    if (!motors_off(device) || lasting_causes(sensors) != 0u || mismatch) {
        return false;
    }
    device->faults = 0u;
    rest(device, time_s, IDLE);
    return true;
}

static void receive_command(
    struct tormag_device *device,
    double time_s,
    uint8_t function,
    uint8_t nonce,
    const struct tormag_sensors *sensors)
{
    if (nonce == device->nonce) {
        return;
    }
    bool accepted = false;
    if (function == TORMAG_FUNCTION_RETRACT) {
        accepted = obey_retract(device, time_s, sensors);
    } else if (function == TORMAG_FUNCTION_HOME) {
        accepted = obey_home(device, time_s, sensors);
    } else if (function == TORMAG_FUNCTION_CLEAR) {
        accepted = obey_clear(device, time_s, sensors);
    }
    if (accepted) {
        device->nonce = nonce;
    }
}

enum tormag_answer tormag_device_receive(
    struct tormag_device *device,
    double time_s,
    const struct tormag_message *message,
    const struct tormag_sensors *sensors)
{
    switch (message->function) {
    case TORMAG_FUNCTION_DRIVE:
        return receive_drive(device, time_s, &message->signals.drive, sensors);
    case TORMAG_FUNCTION_HELLO:
        return receive_hello(device, time_s, &message->signals.hello, sensors);
    case TORMAG_FUNCTION_RETRACT:
        receive_command(device, time_s, message->function, message->signals.retract.nonce, sensors);
        return TORMAG_ANSWER_NONE;
    case TORMAG_FUNCTION_HOME:
        receive_command(device, time_s, message->function, message->signals.home.nonce, sensors);
        return TORMAG_ANSWER_NONE;
    case TORMAG_FUNCTION_CLEAR:
        receive_command(device, time_s, message->function, message->signals.clear.nonce, sensors);
        return TORMAG_ANSWER_NONE;
    default:
        return TORMAG_ANSWER_NONE;
    }
}

/* -- time ---------------------------------------------------------------------------------------------------------- */

static void tick_run(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    struct tormag_carriage carriages[TORMAG_SIDES];
    read_carriages(device, sensors, carriages);
    unsigned int fault = lasting_causes(sensors) | overcurrent(device, time_s, sensors);
    if (time_s - device->drive_s > COMMAND_TIMEOUT_S) {
        fault |= COMMAND_TIMEOUT;
    }
    if ((sensors->switches & CLOSED_SWITCHES) != 0u) {
        fault |= END_STOP;
    }
    if (fabs(carriages[TORMAG_LEFT].position_mm - carriages[TORMAG_RIGHT].position_mm) > MAX_SKEW_MM) {
        fault |= SKEW;
    }
    if (fault != 0u) {
        fail(device, time_s, fault, sensors);
        return;
    }
    bound_output(&device->output, sensors);
}

static void tick_homing(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    struct tormag_homing *homing = &device->motion.homing;
    struct tormag_carriage carriages[TORMAG_SIDES];
    const unsigned int causes = lasting_causes(sensors) | overcurrent(device, time_s, sensors);
    if (causes != 0u) {
        fail(device, time_s, causes, sensors);
        return;
    }
    read_carriages(device, sensors, carriages);
    const enum tormag_outcome outcome = tormag_homing_step(homing, time_s, carriages);
    for (int side = 0; side < TORMAG_SIDES; side++) {
        device->output.duty[side] = homing->duties[side];
    }
    device->output.enabled = true;
    if (outcome == TORMAG_REVERSED) { /* to open is just what cannot be: friction holds the gap where it is */
        device->faults |= HOMING_FAILED;
        rest(device, time_s, LATCHED);
    } else if (outcome == TORMAG_FAILED) {
        fail(device, time_s, HOMING_FAILED, sensors);
    } else if (outcome == TORMAG_DONE) {
        for (int side = 0; side < TORMAG_SIDES; side++) {
            device->zeros_mm[side] += homing->zeros_mm[side];
        }
        device->homed = true;
        rest(device, time_s, device->faults != 0u ? LATCHED : IDLE);
    }
}

static void tick_retracting(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    struct tormag_retraction *retraction = &device->motion.retraction;
    struct tormag_carriage carriages[TORMAG_SIDES];
    if (!tormag_retraction_blocked(retraction) && slipped(device, time_s, sensors)) {
        device->faults |= UNCOMMANDED_MOTION;
    }
    if (tormag_retraction_late(retraction, time_s)) {
        device->faults |= RETRACT_FAILED;
    }
    read_carriages(device, sensors, carriages);
    const enum tormag_outcome outcome = tormag_retraction_step(retraction, time_s, carriages);
    for (int side = 0; side < TORMAG_SIDES; side++) {
        device->output.duty[side] = retraction->openings[side].duty;
    }
    device->output.enabled = true;
    if (outcome == TORMAG_MOVING) {
        return;
    }
    if (outcome == TORMAG_FAILED) {
        device->faults |= RETRACT_FAILED;
    }
    rest(device, time_s, device->faults != 0u ? LATCHED : IDLE);
}

static void tick_rest(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    if (slipped(device, time_s, sensors)) {
        fail(device, time_s, UNCOMMANDED_MOTION, sensors);
        return;
    }
    const unsigned int fresh = lasting_causes(sensors) & ~(unsigned int)device->faults;
    if (fresh != 0u) {
        fail(device, time_s, fresh, sensors);
    }
}

bool tormag_device_tick(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors)
{
    switch (device->mode) {
    case RUN:
        tick_run(device, time_s, sensors);
        break;
    case HOMING:
        tick_homing(device, time_s, sensors);
        break;
    case RETRACTING:
        tick_retracting(device, time_s, sensors);
        break;
    default:
        tick_rest(device, time_s, sensors);
        break;
    }
    device->status_ticks = (uint8_t)((device->status_ticks + 1u) % STATUS_TICKS);
    return device->status_ticks == 0u;
}
