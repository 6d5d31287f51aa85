/*
 * The sources as a host calls them: payload bytes in, payload bytes out. For simulation and tests, no part of a
 * firmware.
 */
#ifndef TORMAG_BRIDGE_H
#define TORMAG_BRIDGE_H

#include "../codec.h"
#include "../device.h"

/* What can be read of a device. */
struct tormag_bridge_view {
    uint8_t mode;
    uint16_t faults;
    bool homed;
    struct tormag_output output;
};

/* Bytes of struct tormag_device, tormag_device_parameters, tormag_sensors and tormag_bridge_view. */
void tormag_bridge_sizes(size_t sizes[4]);

/* The tormag_answer that the payload calls for, or, for one that is no message, minus its tormag_result. */
int tormag_bridge_receive(
    struct tormag_device *device,
    double time_s,
    uint8_t function,
    const uint8_t *payload,
    size_t length,
    const struct tormag_sensors *sensors);

/* The length of the Status that is due, 0 without one, -1 for one whose values do not fit. */
int tormag_bridge_tick(
    struct tormag_device *device, double time_s, const struct tormag_sensors *sensors, uint8_t *payload);

/* State and, at payloads + TORMAG_MAX_PAYLOAD, Sense: 0, or -1 if their values do not fit. */
int tormag_bridge_measurement(
    struct tormag_device *device, double time_s, const struct tormag_sensors *sensors, uint8_t *payloads);

/* The same for a Status at any time, and for Identity, which always fits. */
int tormag_bridge_status(const struct tormag_device *device, const struct tormag_sensors *sensors, uint8_t *payload);
int tormag_bridge_identity(const struct tormag_device *device, uint8_t *payload);

void tormag_bridge_view(const struct tormag_device *device, struct tormag_bridge_view *view);

#endif
