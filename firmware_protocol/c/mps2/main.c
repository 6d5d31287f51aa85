/* The firmware over a board: one task, which sleeps between the tick and the bytes of the link. */
#include "../codec.h"
#include "../framing.h"
#include "../reports.h"
#include "board.h"

static struct tormag_device device;
static struct tormag_frame_decoder decoder;
static uint8_t sequence;

static void send(const struct tormag_message *message)
{
    uint8_t payload[TORMAG_MAX_PAYLOAD];
    uint8_t frame[TORMAG_MAX_FRAME];
    size_t length;
    if (tormag_encode(payload, &length, message) == TORMAG_OK) {
        board_send(frame, tormag_frame_encode(frame, message->function, sequence, payload, length));
        sequence++;
    }
}

static void answer(enum tormag_answer wanted, double time_s, const struct tormag_sensors *sensors)
{
    struct tormag_message first;
    struct tormag_message second;
    if (wanted == TORMAG_ANSWER_IDENTITY) {
        tormag_report_identity(&device, &first);
        send(&first);
    } else if (
        wanted == TORMAG_ANSWER_MEASUREMENT
        && tormag_report_measurement(&device, time_s, sensors, &first, &second)) {
        send(&first);
        send(&second);
    }
}

static void receive(double time_s, const struct tormag_sensors *sensors)
{
    uint8_t byte;
    struct tormag_frame frame;
    struct tormag_message message;
    while (board_receive(&byte)) {
        if (tormag_frame_decoder_push(&decoder, byte, &frame)
            && tormag_decode(&message, frame.function, frame.payload, frame.length) == TORMAG_OK) {
            answer(tormag_device_receive(&device, time_s, &message, sensors), time_s, sensors);
        }
    }
}

static void tick(double time_s, const struct tormag_sensors *sensors)
{
    struct tormag_message status;
    if (tormag_device_tick(&device, time_s, sensors) && tormag_report_status(&device, sensors, &status)) {
        send(&status);
    }
}

int main(void)
{
    struct tormag_device_parameters parameters;
    struct tormag_sensors sensors;
    board_start(&parameters);
    tormag_device_init(&device, &parameters);
    tormag_frame_decoder_init(&decoder);
    for (;;) {
        const bool is_tick = board_wait(&sensors);
        const double time_s = board_time_s();
        receive(time_s, &sensors);
        if (is_tick) {
            tick(time_s, &sensors);
        }
        board_drive(&device);
    }
}
