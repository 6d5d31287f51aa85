/*
 * A filter that puts the firmware's sources to work under sanitizers: one request a line on stdin, one answer a line on
 * stdout. Bytes are in hexadecimal, none of them is "-"; SENSORS are the nine numbers of struct tormag_sensors.
 *
 *     decode FUNCTION BYTES           ok BYTES (decoded and encoded again), or refused RESULT
 *     frame FUNCTION SEQUENCE BYTES   the frame's BYTES
 *     stream BYTES                    FUNCTION:SEQUENCE:BYTES of each frame, then a decoder's six counts; carries on
 *     restart                         - and a new decoder
 *     device LEAD STALL MM_PER_COUNT HANDLE_MM_PER_COUNT RETRACT HOMING SERIAL     - and a new device
 *     receive TIME FUNCTION BYTES SENSORS    ANSWER VIEW
 *     tick TIME SENSORS                      LENGTH BYTES VIEW
 *     measure TIME SENSORS                   RESULT BYTES VIEW
 *     identity                               LENGTH BYTES
 *
 * VIEW is MODE FAULTS HOMED LEFT_DUTY RIGHT_DUTY ENABLED. A line that is none of these ends it with exit code 2.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../framing.h"
#include "bridge.h"

#define MAX_LINE 8192
#define SEPARATORS " \n"

static struct tormag_frame_decoder decoder;
static struct tormag_device device;

static void fail(const char *reason)
{
    fprintf(stderr, "exchange: %s\n", reason);
    exit(2);
}

static const char *next_word(void)
{
    const char *word = strtok(NULL, SEPARATORS);
    if (word == NULL) {
        fail("a word is missing");
    }
    return word;
}

static double next_number(void)
{
    return strtod(next_word(), NULL);
}

static uint8_t next_byte(void)
{
    return (uint8_t)strtoul(next_word(), NULL, 10);
}

/* In a block of exactly their size, so that the address sanitizer sees one byte too many; the caller frees it. */
static uint8_t *next_bytes(size_t *length)
{
    const char *word = next_word();
    *length = strcmp(word, "-") == 0 ? 0u : strlen(word) / 2u;
    uint8_t *bytes = malloc(*length > 0u ? *length : 1u);
    if (bytes == NULL) {
        fail("out of memory");
    }
    for (size_t i = 0; i < *length; i++) {
        const char digits[3] = {word[2u * i], word[2u * i + 1u], '\0'};
        bytes[i] = (uint8_t)strtoul(digits, NULL, 16);
    }
    return bytes;
}

static struct tormag_sensors next_sensors(void)
{
    struct tormag_sensors sensors;
    sensors.counts[TORMAG_LEFT] = (int32_t)next_number();
    sensors.counts[TORMAG_RIGHT] = (int32_t)next_number();
    sensors.current_A[TORMAG_LEFT] = next_number();
    sensors.current_A[TORMAG_RIGHT] = next_number();
    sensors.force_N = next_number();
    sensors.handle_counts = (int32_t)next_number();
    sensors.switches = next_byte();
    sensors.supply_V = next_number();
    sensors.temperature_C = next_number();
    return sensors;
}

static void print_bytes(const uint8_t *bytes, size_t length)
{
    if (length == 0u) {
        fputs("-", stdout);
    }
    for (size_t i = 0; i < length; i++) {
        printf("%02x", (unsigned int)bytes[i]);
    }
}

static void print_view(void)
{
    struct tormag_bridge_view view;
    tormag_bridge_view(&device, &view);
    printf(" %d %d %d", view.mode, view.faults, view.homed);
    printf(" %a %a %d\n", view.output.duty[TORMAG_LEFT], view.output.duty[TORMAG_RIGHT], view.output.enabled);
}

static void decode(void)
{
    const uint8_t function = next_byte();
    size_t length;
    uint8_t *payload = next_bytes(&length);
    struct tormag_message message;
    enum tormag_result result = tormag_decode(&message, function, payload, length);
    free(payload);
    if (result == TORMAG_OK) {
        uint8_t again[TORMAG_MAX_PAYLOAD];
        result = tormag_encode(again, &length, &message);
        if (result == TORMAG_OK) {
            fputs("ok ", stdout);
            print_bytes(again, length);
            fputs("\n", stdout);
            return;
        }
    }
    printf("refused %d\n", (int)result);
}

static void frame(void)
{
    const uint8_t function = next_byte();
    const uint8_t sequence = next_byte();
    size_t length;
    uint8_t *payload = next_bytes(&length);
    uint8_t bytes[TORMAG_MAX_FRAME];
    const size_t frame_length = tormag_frame_encode(bytes, function, sequence, payload, length);
    free(payload);
    print_bytes(bytes, frame_length);
    fputs("\n", stdout);
}

static void stream(void)
{
    size_t length;
    uint8_t *bytes = next_bytes(&length);
    struct tormag_frame received;
    for (size_t i = 0; i < length; i++) {
        if (tormag_frame_decoder_push(&decoder, bytes[i], &received)) {
            printf("%d:%d:", received.function, received.sequence);
            print_bytes(received.payload, received.length);
            fputs(" ", stdout);
        }
    }
    free(bytes);
    const struct tormag_framing_statistics *seen = &decoder.statistics;
    printf("%lu %lu %lu", (unsigned long)seen->bytes, (unsigned long)seen->frames, (unsigned long)seen->corrupt);
    printf(" %lu %lu", (unsigned long)seen->lost, (unsigned long)seen->repeated);
    printf(" %lu\n", (unsigned long)seen->resynchronisations);
}

static void make_device(void)
{
    struct tormag_device_parameters parameters;
    parameters.drive_train.lead_mm = next_number();
    parameters.drive_train.stall_A = next_number();
    parameters.mm_per_count = next_number();
    parameters.handle_mm_per_count = next_number();
    parameters.retract_mm_s = next_number();
    parameters.homing_mm_s = next_number();
    parameters.serial_number = (uint16_t)next_number();
    tormag_device_init(&device, &parameters);
    fputs("-\n", stdout);
}

static void receive(void)
{
    const double time_s = next_number();
    const uint8_t function = next_byte();
    size_t length;
    uint8_t *payload = next_bytes(&length);
    const struct tormag_sensors sensors = next_sensors();
    printf("%d", tormag_bridge_receive(&device, time_s, function, payload, length, &sensors));
    free(payload);
    print_view();
}

static void tick(void)
{
    const double time_s = next_number();
    const struct tormag_sensors sensors = next_sensors();
    uint8_t payload[TORMAG_MAX_PAYLOAD];
    const int length = tormag_bridge_tick(&device, time_s, &sensors, payload);
    printf("%d ", length);
    print_bytes(payload, length > 0 ? (size_t)length : 0u);
    print_view();
}

static void measure(void)
{
    const double time_s = next_number();
    const struct tormag_sensors sensors = next_sensors();
    uint8_t payloads[2u * TORMAG_MAX_PAYLOAD];
    const int result = tormag_bridge_measurement(&device, time_s, &sensors, payloads);
    printf("%d ", result);
    print_bytes(payloads, result == 0 ? sizeof payloads : 0u);
    print_view();
}

static void identity(void)
{
    uint8_t payload[TORMAG_MAX_PAYLOAD];
    const int length = tormag_bridge_identity(&device, payload);
    printf("%d ", length);
    print_bytes(payload, length > 0 ? (size_t)length : 0u);
    fputs("\n", stdout);
}

static void restart(void)
{
    tormag_frame_decoder_init(&decoder);
    fputs("-\n", stdout);
}

static const struct {
    const char *name;
    void (*answer)(void);
} REQUESTS[] = {
    {"decode", decode},
    {"frame", frame},
    {"stream", stream},
    {"restart", restart},
    {"device", make_device},
    {"receive", receive},
    {"tick", tick},
    {"measure", measure},
    {"identity", identity},
};

int main(void)
{
    static char line[MAX_LINE];
    tormag_frame_decoder_init(&decoder);
    while (fgets(line, sizeof line, stdin) != NULL) {
        const char *name = strtok(line, SEPARATORS);
        size_t request = 0u;
        while (request < sizeof REQUESTS / sizeof REQUESTS[0]
               && (name == NULL || strcmp(name, REQUESTS[request].name) != 0)) {
            request++;
        }
        if (request == sizeof REQUESTS / sizeof REQUESTS[0]) {
            fail("unknown request");
        }
        REQUESTS[request].answer();
    }
    return 0;
}
