/*
 * The device's safety logic: a state machine of device time, messages and sensors, without a clock, a line or a pin of
 * its own.
 *
 *     IDLE --Home--> HOMING --> IDLE, homed --Drive RUN--> RUN --Drive OFF, Retract, silence, fault--> RETRACTING
 *     RETRACTING --> IDLE at the open end, or LATCHED there when a fault is behind it; LATCHED --Clear--> IDLE
 *
 * The safe state is the open gap, reached at a bounded speed: friction holds the gap when the drives go off, and when
 * it does not, the magnets pull it shut. So everything that ends a run opens first and switches off then.
 *
 * All times are device time in seconds since the boot and never fall; all values that come in are finite. Nothing here
 * allocates, recurses, waits, or keeps state outside `struct tormag_device`, which may be copied. One thread of
 * execution at a time: call from one task, or with the tick's interrupt masked.
 */
#ifndef TORMAG_DEVICE_H
#define TORMAG_DEVICE_H

#include <stdbool.h>
#include <stdint.h>

#include "messages.h"
#include "motion.h"

#define TORMAG_FIRMWARE_MAJOR 1u
#define TORMAG_FIRMWARE_MINOR 0u

/* What differs from one device to the next. */
struct tormag_device_parameters {
    struct tormag_drive_train drive_train; /* its stall_A is also the level of OVERCURRENT */
    double mm_per_count;                   /* carriage encoders */
    double handle_mm_per_count;            /* roller surface */
    double retract_mm_s;                   /* bounded speed of opening with a valid zero */
    double homing_mm_s;                    /* and without one */
    uint16_t serial_number;
};

/* What the electronics measure; encoder counts since the boot, positive opening. */
struct tormag_sensors {
    int32_t counts[TORMAG_SIDES];
    double current_A[TORMAG_SIDES];
    double force_N;
    int32_t handle_counts;
    uint8_t switches; /* TORMAG_STATUS_SWITCHES_..._CHOICE, of the four end switches */
    double supply_V;
    double temperature_C;
};

/* What the bridges do: duties in [-1, 1], or, not enabled, open. */
struct tormag_output {
    double duty[TORMAG_SIDES];
    bool enabled;
};

/* What a received message calls for. */
enum tormag_answer {
    TORMAG_ANSWER_NONE = 0,
    TORMAG_ANSWER_IDENTITY,   /* send tormag_report_identity() */
    TORMAG_ANSWER_MEASUREMENT /* send tormag_report_measurement() */
};

/* One device's firmware from its boot on. `mode`, `faults`, `homed`, `output` are for reading; the rest is its own. */
struct tormag_device {
    uint8_t mode;    /* TORMAG_STATUS_MODE_..._CHOICE */
    uint16_t faults; /* TORMAG_STATUS_FAULTS_..._CHOICE */
    bool homed;
    struct tormag_output output;

    struct tormag_device_parameters parameters;
    double zeros_mm[TORMAG_SIDES];
    bool compatible;
    bool may_run;
    union {
        struct tormag_retraction retraction; /* in RETRACTING */
        struct tormag_homing homing;         /* in HOMING */
    } motion;
    int16_t drive_counter; /* of the last accepted Drive, -1 before the first */
    double drive_s;
    uint8_t nonce; /* of the last accepted command, 0 before the first */
    double calm_s[TORMAG_SIDES];
    double watch_since_s;
    bool watching;
    int32_t watch_counts[TORMAG_SIDES];
    uint8_t status_ticks;
    uint8_t state_counter;
};

void tormag_device_init(struct tormag_device *device, const struct tormag_device_parameters *parameters);

/* Acts on one message that tormag_decode() accepted; those of a device are ignored. */
enum tormag_answer tormag_device_receive(
    struct tormag_device *device,
    double time_s,
    const struct tormag_message *message,
    const struct tormag_sensors *sensors);

/* The tick, every TORMAG_TICK_S: motions and watches. True every twentieth time: send tormag_report_status(). */
bool tormag_device_tick(struct tormag_device *device, double time_s, const struct tormag_sensors *sensors);

/* Carriage position relative to home. */
double tormag_device_position_mm(
    const struct tormag_device *device, const struct tormag_sensors *sensors, enum tormag_side side);

#endif
