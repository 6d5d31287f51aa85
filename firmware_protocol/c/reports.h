/* The messages that a device sends, from its state and what it measures. */
#ifndef TORMAG_REPORTS_H
#define TORMAG_REPORTS_H

#include "device.h"

/*
 * False, and nothing is to be sent, for a measured value that does not fit its signal: a host that hears
 * nothing stops, one that hears a clamped value goes on.
 */
bool tormag_report_status(
    const struct tormag_device *device, const struct tormag_sensors *sensors, struct tormag_message *status);
bool tormag_report_measurement(
    struct tormag_device *device,
    double time_s,
    const struct tormag_sensors *sensors,
    struct tormag_message *state,
    struct tormag_message *sense);
void tormag_report_identity(const struct tormag_device *device, struct tormag_message *identity);

#endif
