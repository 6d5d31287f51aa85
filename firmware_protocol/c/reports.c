#include "reports.h"

#include <math.h>

/* The step nearest to a physical value, halves to even; false if it is not finite or not in the range. */
static bool step_within(double value, double scale, double lowest, double highest, double *step)
{
    *step = rint(value / scale);
    return lowest <= *step && *step <= highest;
}

static bool step_int16(double value, double scale, int16_t *step)
{
    double whole;
    if (!step_within(value, scale, INT16_MIN, INT16_MAX, &whole)) {
        return false;
    }
    *step = (int16_t)whole;
    return true;
}

/* The step of a signal that wraps, modulo 2^16; false for a value that is not finite. */
static bool step_wrapping(double value, double scale, uint16_t *step)
{
    const double wrapped = fmod(rint(value / scale), 65536.0);
    if (!isfinite(wrapped)) {
        return false;
    }
    *step = (uint16_t)(wrapped < 0.0 ? wrapped + 65536.0 : wrapped);
    return true;
}

/* Two's complement without leaning on what a conversion out of range does. */
static int16_t signed_step(uint16_t step)
{
    return (int16_t)(step < 0x8000u ? (int32_t)step : (int32_t)step - 0x10000);
}

bool tormag_report_status(
    const struct tormag_device *device, const struct tormag_sensors *sensors, struct tormag_message *message)
{
    struct tormag_status_t *status = &message->signals.status;
    double temperature;
    double supply;
    const bool fits =
        step_within(sensors->temperature_C, TORMAG_STATUS_TEMPERATURE_C_SCALE, INT8_MIN, INT8_MAX, &temperature)
        && step_within(sensors->supply_V, TORMAG_STATUS_SUPPLY_V_SCALE, 0.0, UINT8_MAX, &supply);
    if (!fits) {
        return false;
    }
    message->function = TORMAG_FUNCTION_STATUS;
    status->mode = device->mode;
    status->switches = (uint8_t)(sensors->switches | (device->homed ? TORMAG_STATUS_SWITCHES_HOMED_CHOICE : 0u));
    status->faults = device->faults;
    status->temperature_c = (int8_t)temperature;
    status->supply_v = (uint8_t)supply;
    /* before any was accepted, 0 */
    status->drive_counter = (uint8_t)(device->drive_counter < 0 ? 0 : device->drive_counter);
    status->command_nonce = device->nonce;
    return true;
}

bool tormag_report_measurement(
    struct tormag_device *device,
    double time_s,
    const struct tormag_sensors *sensors,
    struct tormag_message *state_message,
    struct tormag_message *sense_message)
{
    struct tormag_state_t *state = &state_message->signals.state;
    struct tormag_sense_t *sense = &sense_message->signals.sense;
    const double left_mm = tormag_device_position_mm(device, sensors, TORMAG_LEFT);
    const double right_mm = tormag_device_position_mm(device, sensors, TORMAG_RIGHT);
    uint16_t left;
    uint16_t right;
    device->state_counter++;
    state_message->function = TORMAG_FUNCTION_STATE;
    sense_message->function = TORMAG_FUNCTION_SENSE;
    const bool fits =
        step_wrapping(left_mm, TORMAG_STATE_LEFT_POSITION_MM_SCALE, &left)
        && step_wrapping(right_mm, TORMAG_STATE_RIGHT_POSITION_MM_SCALE, &right)
        && step_wrapping(time_s, TORMAG_STATE_DEVICE_TIME_S_SCALE, &state->device_time_s)
        && step_int16(sensors->current_A[TORMAG_LEFT], TORMAG_SENSE_LEFT_CURRENT_A_SCALE, &sense->left_current_a)
        && step_int16(sensors->current_A[TORMAG_RIGHT], TORMAG_SENSE_RIGHT_CURRENT_A_SCALE, &sense->right_current_a)
        && step_int16(sensors->force_N, TORMAG_SENSE_FORCE_N_SCALE, &sense->force_n)
        && step_wrapping(
            (double)sensors->handle_counts * device->parameters.handle_mm_per_count,
            TORMAG_SENSE_HANDLE_POSITION_MM_SCALE,
            &sense->handle_position_mm);
    if (!fits) {
        return false;
    }
    state->left_position_mm = signed_step(left);
    state->right_position_mm = signed_step(right);
    state->counter = device->state_counter;
    state->crc = 0u; /* tormag_encode() computes it */
    return true;
}

void tormag_report_identity(const struct tormag_device *device, struct tormag_message *message)
{
    struct tormag_identity_t *identity = &message->signals.identity;
    message->function = TORMAG_FUNCTION_IDENTITY;
    identity->schema_hash = TORMAG_SCHEMA_HASH;
    identity->firmware_major = TORMAG_FIRMWARE_MAJOR;
    identity->firmware_minor = TORMAG_FIRMWARE_MINOR;
    identity->serial_number = device->parameters.serial_number;
}
