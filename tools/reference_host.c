/*
 * A host in C: what the wire and the kernel of this machine allow, beside which the daemon is measured.
 *
 *     reference_host PORT PERIOD_US SECONDS FIFO
 *
 * It has the daemon's wire, period and framing, homes the device and holds a gap with two PIDs. It has no setpoints,
 * no model, no clients and no record. It reads at the tick alone. It prints one JSON object at its end.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/timerfd.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "codec.h"
#include "framing.h"

#define NS 1000000000LL
#define MOST_TICKS (4000u * 3600u)
#define CLOSED_MM (-5.0) /* of the home switches: where both carriages are held */
#define SIDES 2

struct host {
    int port;
    struct tormag_frame_decoder decoder;
    uint8_t sequence, counter, nonce;
    bool is_known, is_homed, is_new, has_started, has_fault;
    uint8_t mode;
    double position_mm[SIDES], last_mm[SIDES], integral[SIDES];
};

static long long now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (long long)now.tv_sec * NS + now.tv_nsec;
}

static void fail(const char *what)
{
    fprintf(stderr, "reference_host: %s: %s\n", what, strerror(errno));
    exit(1);
}

static int open_port(const char *path)
{
    int port = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    struct termios line;
    if (port < 0 || tcgetattr(port, &line) != 0)
        fail(path);
    cfmakeraw(&line);
    if (tcsetattr(port, TCSANOW, &line) != 0)
        fail(path);
    return port;
}

static void send_message(struct host *host, const struct tormag_message *message)
{
    uint8_t payload[TORMAG_MAX_PAYLOAD], frame[TORMAG_MAX_FRAME];
    size_t length = 0;
    if (tormag_encode(payload, &length, message) != TORMAG_OK)
        return;
    length = tormag_frame_encode(frame, message->function, host->sequence++, payload, length);
    if (write(host->port, frame, length) != (ssize_t)length && errno != EAGAIN)
        fail("writing");
}

static void take(struct host *host, const struct tormag_message *message)
{
    switch (message->function) {
    case TORMAG_FUNCTION_IDENTITY:
        host->is_known = true;
        break;
    case TORMAG_FUNCTION_STATE:
        host->position_mm[0] = message->signals.state.left_position_mm * TORMAG_STATE_LEFT_POSITION_MM_SCALE;
        host->position_mm[1] = message->signals.state.right_position_mm * TORMAG_STATE_RIGHT_POSITION_MM_SCALE;
        host->is_new = true;
        break;
    case TORMAG_FUNCTION_STATUS:
        host->mode = message->signals.status.mode;
        host->is_homed = message->signals.status.switches & TORMAG_STATUS_SWITCHES_HOMED_CHOICE;
        if (host->has_started && message->signals.status.faults)
            host->has_fault = true;
        break;
    default:
        break;
    }
}

static void receive(struct host *host)
{
    uint8_t bytes[4096];
    ssize_t count = read(host->port, bytes, sizeof bytes);
    if (count < 0 && errno != EAGAIN)
        fail("reading");
    for (ssize_t place = 0; place < count; place++) {
        struct tormag_frame frame;
        struct tormag_message message;
        if (tormag_frame_decoder_push(&host->decoder, bytes[place], &frame)
            && tormag_decode(&message, frame.function, frame.payload, frame.length) == TORMAG_OK)
            take(host, &message);
    }
}

static int16_t pid(struct host *host, int side, double period_s)
{
    double error_mm = CLOSED_MM - host->position_mm[side];
    double speed_mm_s = (host->position_mm[side] - host->last_mm[side]) / period_s;
    double duty = 1.5 * error_mm + 0.5 * host->integral[side] - 0.05 * speed_mm_s;
    host->last_mm[side] = host->position_mm[side];
    if (duty > -0.5 && duty < 0.5)
        host->integral[side] += error_mm * period_s;
    duty = duty > 0.5 ? 0.5 : duty < -0.5 ? -0.5 : duty;
    return (int16_t)(duty / TORMAG_DRIVE_LEFT_DUTY_SCALE);
}

static void drive(struct host *host, double period_s)
{
    struct tormag_message message = {.function = TORMAG_FUNCTION_DRIVE};
    bool may_run = host->is_homed && (host->mode == TORMAG_STATUS_MODE_IDLE_CHOICE || host->has_started);
    host->has_started = host->has_started || may_run;
    message.signals.drive.left_duty = may_run ? pid(host, 0, period_s) : 0;
    message.signals.drive.right_duty = may_run ? pid(host, 1, period_s) : 0;
    message.signals.drive.mode = may_run ? TORMAG_DRIVE_MODE_RUN_CHOICE : TORMAG_DRIVE_MODE_OFF_CHOICE;
    message.signals.drive.counter = ++host->counter;
    send_message(host, &message);
}

static void ask(struct host *host)
{
    struct tormag_message message = {.function = TORMAG_FUNCTION_HELLO};
    message.signals.hello.schema_hash = TORMAG_SCHEMA_HASH;
    message.signals.hello.protocol_version = TORMAG_PROTOCOL_VERSION;
    message.signals.hello.nonce = 255;
    if (host->is_known) {
        if (host->is_homed || host->mode == TORMAG_STATUS_MODE_HOMING_CHOICE)
            return;
        message.function = TORMAG_FUNCTION_HOME;
        message.signals.home.nonce = ++host->nonce;
    }
    send_message(host, &message);
}

static int compare(const void *one, const void *other)
{
    float a = *(const float *)one, b = *(const float *)other;
    return (a > b) - (a < b);
}

int main(int count, char **words)
{
    if (count != 5) {
        fprintf(stderr, "reference_host PORT PERIOD_US SECONDS FIFO\n");
        return 2;
    }
    long long period_ns = atoll(words[2]) * 1000LL;
    size_t ticks = (size_t)(atof(words[3]) * (double)NS / (double)period_ns);
    struct sched_param priority = {.sched_priority = atoi(words[4])};
    float *late_us = ticks > 0 && ticks < MOST_TICKS ? calloc(ticks, sizeof *late_us) : NULL;
    if (late_us == NULL)
        fail("PERIOD_US, SECONDS");
    static struct host host;
    host.port = open_port(words[1]);
    tormag_frame_decoder_init(&host.decoder);
    bool is_granted = priority.sched_priority > 0 && sched_setscheduler(0, SCHED_FIFO, &priority) == 0;
    mlockall(MCL_CURRENT | MCL_FUTURE);
    int timer = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC);
    long long due_ns = now_ns() + period_ns;
    struct itimerspec setting = {
        .it_interval = {period_ns / NS, period_ns % NS}, .it_value = {due_ns / NS, due_ns % NS}};
    if (timer < 0 || timerfd_settime(timer, TFD_TIMER_ABSTIME, &setting, NULL) != 0)
        fail("timer");
    size_t done = 0, fresh = 0, asked = 0;
    unsigned long long merged = 0;
    struct timespec ran = {0, 0}, ended;
    struct rusage before, after;
    long long began_ns = 0;
    /* it begins to count when the device runs, or after 20 s */
    for (due_ns -= period_ns; done < ticks;) {
        uint64_t beats = 0;
        if (read(timer, &beats, sizeof beats) != sizeof beats)
            fail("timer");
        long long woken_ns = now_ns();
        due_ns += (long long)beats * period_ns;
        host.is_new = false;
        receive(&host);
        drive(&host, (double)period_ns / (double)NS);
        if (++asked % (size_t)(NS / 20 / period_ns) == 0)
            ask(&host);
        if (began_ns == 0) {
            if (!host.has_started && (long long)asked * period_ns < 20 * NS)
                continue;
            began_ns = woken_ns;
            clock_gettime(CLOCK_THREAD_CPUTIME_ID, &ran);
            getrusage(RUSAGE_SELF, &before);
        }
        merged += beats - 1;
        fresh += host.is_new;
        late_us[done++] = (float)(woken_ns - due_ns) / 1e3f;
    }
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &ended);
    double spent_s = (double)(ended.tv_sec - ran.tv_sec) + (double)(ended.tv_nsec - ran.tv_nsec) / (double)NS;
    double lasted_s = (double)(now_ns() - began_ns) / (double)NS;
    getrusage(RUSAGE_SELF, &after);
    qsort(late_us, done, sizeof *late_us, compare);
    printf("{\"ticks\": %zu, \"merged\": %llu, \"fresh_share\": %.5f, \"core_share\": %.4f, \"wakeups_hz\": %.0f, \"kept_running\": %s, "
           "\"fifo_granted\": %s, \"lateness_us\": {\"p50\": %.1f, \"p99\": %.1f, \"p999\": %.1f, \"max\": %.1f}}\n",
        done, merged, (double)fresh / (double)done, spent_s / lasted_s,
        (double)(after.ru_nvcsw - before.ru_nvcsw) / lasted_s, host.has_started && !host.has_fault ? "true" : "false",
        is_granted ? "true" : "false", late_us[done / 2], late_us[done * 99 / 100], late_us[done * 999 / 1000],
        late_us[done - 1]);
    return 0;
}
