#include "bridge.h"

#include "../reports.h"

void tormag_bridge_sizes(size_t sizes[4])
{
    sizes[0] = sizeof(struct tormag_device);
    sizes[1] = sizeof(struct tormag_device_parameters);
    sizes[2] = sizeof(struct tormag_sensors);
    sizes[3] = sizeof(struct tormag_bridge_view);
}

int tormag_bridge_receive(
    struct tormag_device *device,
    double time_s,
    uint8_t function,
    const uint8_t *payload,
    size_t length,
    const struct tormag_sensors *sensors)
{
    struct tormag_message message;
    const enum tormag_result result = tormag_decode(&message, function, payload, length);
    return result == TORMAG_OK ? (int)tormag_device_receive(device, time_s, &message, sensors) : -(int)result;
}

static int send(uint8_t *payload, const struct tormag_message *message)
{
    size_t length;
    return tormag_encode(payload, &length, message) == TORMAG_OK ? (int)length : -1;
}

int tormag_bridge_status(const struct tormag_device *device, const struct tormag_sensors *sensors, uint8_t *payload)
{
    struct tormag_message status;
    return tormag_report_status(device, sensors, &status) ? send(payload, &status) : -1;
}

int tormag_bridge_tick(
    struct tormag_device *device, double time_s, const struct tormag_sensors *sensors, uint8_t *payload)
{
    return tormag_device_tick(device, time_s, sensors) ? tormag_bridge_status(device, sensors, payload) : 0;
}

int tormag_bridge_measurement(
    struct tormag_device *device, double time_s, const struct tormag_sensors *sensors, uint8_t *payloads)
{
    struct tormag_message state;
    struct tormag_message sense;
    if (!tormag_report_measurement(device, time_s, sensors, &state, &sense)) {
        return -1;
    }
    return send(payloads, &state) > 0 && send(payloads + TORMAG_MAX_PAYLOAD, &sense) > 0 ? 0 : -1;
}

int tormag_bridge_identity(const struct tormag_device *device, uint8_t *payload)
{
    struct tormag_message identity;
    tormag_report_identity(device, &identity);
    return send(payload, &identity);
}

void tormag_bridge_view(const struct tormag_device *device, struct tormag_bridge_view *view)
{
    view->mode = device->mode;
    view->faults = device->faults;
    view->homed = device->homed;
    view->output = device->output;
}
