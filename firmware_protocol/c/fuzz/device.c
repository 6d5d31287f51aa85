/*
 * A device behind its line, two crude carriages, and what bytes do to them: an operation in a byte's low three bits, its
 * size in the other five.
 *
 *     0  so many ticks, four for one          4  bytes of the line, as many, which follow
 *     1  a late tick, by the next byte / 64 s 5  a message with right CRCs: FUNCTION and its payload follow
 *     2  a sensor reads the next two bytes    6  a host's message, with the next counter or nonce; its duty follows
 *     3  what is wrong is put right           7  so many Drives of RUN, one a tick; their duty follows
 */
#include "fuzz.h"

#include <string.h>

#include "../codec.h"
#include "../crc.h"
#include "../device.h"
#include "../framing.h"
#include "../reports.h"

#define MAX_TICKS 4000
#define SPEED_MM_S 20.0
#define COMMAND_TIMEOUT_S 0.05
#define ALL_FAULTS 1023u
#define CLOSED_MM (-25.25)
#define STOP_MM 0.5

enum {
    IDLE = TORMAG_STATUS_MODE_IDLE_CHOICE,
    RUN = TORMAG_STATUS_MODE_RUN_CHOICE,
    HOMING = TORMAG_STATUS_MODE_HOMING_CHOICE,
    LATCHED = TORMAG_STATUS_MODE_LATCHED_CHOICE
};

static const struct tormag_device_parameters PARAMETERS = {{8.0, 3.0}, 8.0 / 4480.0, 0.004, 15.0, 8.0, 1u};

struct world {
    struct tormag_device device;
    struct tormag_frame_decoder decoder;
    double time_s;
    double run_s; /* when it last heard a Drive of RUN */
    int ticks;
    double places_mm[TORMAG_SIDES];
    int32_t extra_counts[TORMAG_SIDES];
    bool held;
    uint8_t stuck_switches;
    bool has_current;
    struct tormag_sensors sensors;
    uint8_t counter, nonce;
    const uint8_t *data;
    size_t left;
};

static uint8_t next(struct world *world)
{
    if (world->left == 0u) {
        return 0u;
    }
    world->left--;
    return *world->data++;
}

static void mend(struct world *world)
{
    world->held = false;
    world->has_current = false;
    world->stuck_switches = 0u;
    world->sensors.supply_V = 12.0;
    world->sensors.temperature_C = 25.0;
    world->sensors.force_N = 0.5;
}

static void sense(struct world *world)
{
    struct tormag_sensors *sensors = &world->sensors;
    const double *places_mm = world->places_mm;
    sensors->switches = world->stuck_switches;
    for (int side = 0; side < TORMAG_SIDES; side++) {
        const int32_t counts = (int32_t)(places_mm[side] / PARAMETERS.mm_per_count);
        sensors->counts[side] = (int32_t)((uint32_t)counts + (uint32_t)world->extra_counts[side]);
        if (!world->has_current) {
            sensors->current_A[side] = world->held ? 4.0 * world->device.output.duty[side] : 0.5;
        }
        if (places_mm[side] >= 0.0) {
            sensors->switches |= (uint8_t)(TORMAG_STATUS_SWITCHES_LEFT_OPEN_CHOICE << side);
        } else if (places_mm[side] <= CLOSED_MM) {
            sensors->switches |= (uint8_t)(TORMAG_STATUS_SWITCHES_LEFT_CLOSED_CHOICE << side);
        }
    }
}

static void move(struct world *world, double dt_s)
{
    for (int side = 0; side < TORMAG_SIDES; side++) {
        const struct tormag_output *output = &world->device.output;
        double place_mm = world->places_mm[side];
        place_mm += output->enabled && !world->held ? SPEED_MM_S * output->duty[side] * dt_s : 0.0;
        place_mm = place_mm > STOP_MM ? STOP_MM : place_mm;
        world->places_mm[side] = place_mm < CLOSED_MM - STOP_MM ? CLOSED_MM - STOP_MM : place_mm;
    }
}

/* What holds after whatever happened; `function` is of the message that did, 0 of none. */
static void judge(const struct world *world, const struct tormag_device *before, uint8_t function)
{
    const struct tormag_device *now = &world->device;
    REQUIRE(now->mode <= LATCHED && now->faults <= ALL_FAULTS);
    for (int side = 0; side < TORMAG_SIDES; side++) {
        const double duty = now->output.duty[side];
        REQUIRE(-1.0 <= duty && duty <= 1.0);
    }
    if (now->mode == IDLE || now->mode == LATCHED) {
        REQUIRE(!now->output.enabled);
        REQUIRE((now->faults != 0u) == (now->mode == LATCHED));
    }
    if (now->mode == RUN) {
        REQUIRE(now->homed && now->compatible && now->faults == 0u);
        REQUIRE(before->mode == RUN || (before->mode == IDLE && function == TORMAG_FUNCTION_DRIVE));
    }
    if (now->mode == HOMING && before->mode != HOMING) {
        REQUIRE(before->mode == IDLE && function == TORMAG_FUNCTION_HOME);
    }
    if ((before->faults & ~(unsigned int)now->faults) != 0u || (before->mode == LATCHED && now->mode == IDLE)) {
        REQUIRE(function == TORMAG_FUNCTION_CLEAR && before->mode == LATCHED && now->faults == 0u);
    }
}

static void send(const struct tormag_message *message)
{
    uint8_t payload[TORMAG_MAX_PAYLOAD];
    size_t length = 0u;
    REQUIRE(tormag_encode(payload, &length, message) == TORMAG_OK);
}

static void tick(struct world *world, double dt_s)
{
    if (world->ticks >= MAX_TICKS) {
        return;
    }
    const struct tormag_device before = world->device;
    struct tormag_message status;
    world->ticks++;
    world->time_s += dt_s;
    move(world, dt_s);
    sense(world);
    if (tormag_device_tick(&world->device, world->time_s, &world->sensors)
        && tormag_report_status(&world->device, &world->sensors, &status)) {
        send(&status);
    }
    judge(world, &before, 0u);
    if (world->device.mode == RUN) {
        REQUIRE(world->time_s - world->run_s <= COMMAND_TIMEOUT_S);
        for (int side = 0; side < TORMAG_SIDES; side++) {
            const unsigned int is_open = world->sensors.switches & (TORMAG_STATUS_SWITCHES_LEFT_OPEN_CHOICE << side);
            REQUIRE(is_open == 0u || world->device.output.duty[side] <= 0.0);
        }
    }
}

static void receive(struct world *world, const struct tormag_message *message)
{
    const struct tormag_device before = world->device;
    struct tormag_message state;
    struct tormag_message sense_message;
    struct tormag_message identity;
    if (message->function == TORMAG_FUNCTION_DRIVE && message->signals.drive.mode == TORMAG_DRIVE_MODE_RUN_CHOICE) {
        world->run_s = world->time_s;
    }
    switch (tormag_device_receive(&world->device, world->time_s, message, &world->sensors)) {
    case TORMAG_ANSWER_MEASUREMENT:
        if (tormag_report_measurement(&world->device, world->time_s, &world->sensors, &state, &sense_message)) {
            send(&state);
            send(&sense_message);
        }
        break;
    case TORMAG_ANSWER_IDENTITY:
        tormag_report_identity(&world->device, &identity);
        send(&identity);
        break;
    case TORMAG_ANSWER_NONE:
        break;
    }
    judge(world, &before, message->function);
}

static void hear(struct world *world, uint8_t byte)
{
    struct tormag_frame frame;
    struct tormag_message message;
    if (tormag_frame_decoder_push(&world->decoder, byte, &frame)
        && tormag_decode(&message, frame.function, frame.payload, frame.length) == TORMAG_OK) {
        receive(world, &message);
    }
}

static void hear_sealed(struct world *world)
{
    uint8_t payload[TORMAG_MAX_PAYLOAD];
    uint8_t bytes[TORMAG_MAX_FRAME];
    const uint8_t function = next(world);
    const size_t length = tormag_message_length(function);
    for (size_t i = 0; i < length; i++) {
        payload[i] = next(world);
    }
    if (length > 0u && tormag_message_protected(function)) {
        payload[length - 1u] = tormag_crc8(function, payload, length - 1u);
    }
    const size_t frame_length = tormag_frame_encode(bytes, function, world->counter++, payload, length);
    for (size_t i = 0; i < frame_length; i++) {
        hear(world, bytes[i]);
    }
}

static void drive(struct world *world, uint8_t mode, uint8_t byte)
{
    struct tormag_message message;
    message.function = TORMAG_FUNCTION_DRIVE;
    message.signals.drive.left_duty = (int16_t)(((int)byte - 128) * 78);
    message.signals.drive.right_duty = message.signals.drive.left_duty;
    message.signals.drive.mode = mode;
    message.signals.drive.counter = ++world->counter;
    receive(world, &message);
}

/* What a host would say: a Hello that fits, a command, a Drive. */
static void hear_host(struct world *world, unsigned int kind)
{
    static const uint8_t COMMANDS[] = {TORMAG_FUNCTION_HOME, TORMAG_FUNCTION_CLEAR, TORMAG_FUNCTION_RETRACT};
    const uint8_t byte = next(world);
    struct tormag_message message;
    if (kind % 6u >= 4u) {
        drive(world, (uint8_t)(kind % 6u - 4u), byte);
        return;
    }
    if (kind % 6u == 3u) {
        message.function = TORMAG_FUNCTION_HELLO;
        message.signals.hello.schema_hash = TORMAG_SCHEMA_HASH;
        message.signals.hello.protocol_version = TORMAG_PROTOCOL_VERSION;
        message.signals.hello.nonce = world->nonce;
    } else {
        message.function = COMMANDS[kind % 6u];
        /* each of the three has a nonce and nothing else */
        message.signals.home.nonce = ++world->nonce;
    }
    receive(world, &message);
}

static void spoil(struct world *world, unsigned int what)
{
    const int32_t low = next(world);
    const int32_t value = low + 256 * (int32_t)(int8_t)next(world);
    struct tormag_sensors *sensors = &world->sensors;
    switch (what % 8u) {
    case 0u:
        world->extra_counts[what / 16u] = value * 65536; /* as far as 32 bits go */
        break;
    case 1u:
        world->extra_counts[what / 16u] = (int32_t)((uint32_t)world->extra_counts[what / 16u] + (uint32_t)value);
        break;
    case 2u:
        sensors->current_A[what / 16u] = value / 1000.0;
        world->has_current = true;
        break;
    case 3u:
        sensors->force_N = value / 256.0;
        break;
    case 4u:
        sensors->supply_V = value / 1000.0;
        break;
    case 5u:
        sensors->temperature_C = value / 100.0;
        break;
    case 6u:
        world->stuck_switches = (uint8_t)(low & 15);
        break;
    default:
        world->held = !world->held;
        sensors->handle_counts = value * 65536;
        break;
    }
}

void tormag_fuzz_device(const uint8_t *data, size_t size)
{
    struct world world;
    memset(&world, 0, sizeof world);
    world.data = data;
    world.left = size;
    world.places_mm[TORMAG_LEFT] = world.places_mm[TORMAG_RIGHT] = -0.3;
    tormag_device_init(&world.device, &PARAMETERS);
    tormag_frame_decoder_init(&world.decoder);
    mend(&world);
    sense(&world);
    while (world.left > 0u) {
        const uint8_t operation = next(&world);
        const unsigned int count = operation >> 3;
        uint8_t duty;
        switch (operation & 7u) {
        case 0u:
            for (unsigned int i = 0; i <= 4u * count; i++) {
                tick(&world, TORMAG_TICK_S);
            }
            break;
        case 1u:
            tick(&world, next(&world) / 64.0);
            break;
        case 2u:
            spoil(&world, count);
            break;
        case 3u:
            mend(&world);
            break;
        case 4u:
            for (unsigned int i = 0; i < count && world.left > 0u; i++) {
                hear(&world, next(&world));
            }
            break;
        case 5u:
            hear_sealed(&world);
            break;
        case 6u:
            hear_host(&world, count);
            break;
        default:
            duty = next(&world);
            for (unsigned int i = 0; i <= count; i++) {
                drive(&world, TORMAG_DRIVE_MODE_RUN_CHOICE, duty);
                tick(&world, TORMAG_TICK_S);
            }
            break;
        }
    }
}
