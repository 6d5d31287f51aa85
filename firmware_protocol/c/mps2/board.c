/*
 * Arm's MPS2 with a Cortex-M4 (AN386), as QEMU's machine mps2-an386: CMSDK timers and UART at 25 MHz.
 *
 * The pins lead to a plant on the host. Semihosting carries them: at a call the processor stands still, and with it the
 * clock, until the plant has answered. So board and plant keep step, and a run repeats to the bit. The timers run only
 * while the board sleeps: what the firmware computes takes no time, as on the host.
 */
#include "board.h"

#include <string.h>

#define CYCLES_PER_TICK 25000u
#define CYCLES_PER_S 25e6
#define PAINT 0xC5C5C5C5u
#define MAX_WAKE_BYTES 64u

struct cmsdk_timer {
    volatile uint32_t ctrl, value, reload, interrupt;
};
struct cmsdk_uart {
    volatile uint32_t data, state, ctrl, interrupt, divisor;
};
struct systick {
    volatile uint32_t ctrl, load, value;
};

#define TICK ((struct cmsdk_timer *)0x40000000)   /* interrupt 8 */
#define ALARM ((struct cmsdk_timer *)0x40001000)  /* interrupt 9 */
#define LINK ((struct cmsdk_uart *)0x40004000)    /* interrupt 0 */
#define COUNT ((struct systick *)0xE000E010)
#define INTERRUPTS_ON (*(volatile uint32_t *)0xE000E100)
#define INTERRUPTS_OFF (*(volatile uint32_t *)0xE000E180)
#define INTERRUPTS_DONE (*(volatile uint32_t *)0xE000E280)
#define TIMER_ON 9u /* counts, and interrupts at 0 */
#define UART_ON 11u /* sends, receives, and interrupts when it has received */
#define UART_FULL 1u
#define UART_RECEIVED 2u
#define SYSTICK_ON 5u
#define SYSTICK_TOP 0xFFFFFFu
#define TIMERS_INTERRUPT 0x300u
#define LINK_INTERRUPT 0x1u

/* -- pins, by semihosting ------------------------------------------------------------------------------------------ */

enum { SYS_OPEN = 1, SYS_WRITE = 5, SYS_READ = 6, SYS_EXIT = 24 };
enum { BINARY_READ = 1, BINARY_WRITE = 5, EXITED = 0x20026 };

/* What the plant says: how long to sleep, the sensors then, the bytes that the link brings. */
struct pins_in {
    struct tormag_sensors sensors;
    uint32_t cycles;
    uint32_t bytes;
};

/* What it is told: the outputs, the bytes that were sent, and how long the processor was busy, in its cycles. */
struct pins_out {
    uint8_t mode;
    uint16_t faults;
    bool homed;
    struct tormag_output output;
    uint32_t sent;
    uint32_t busy;
};

extern uint32_t data_start[], data_end[], data_stored[], bss_start[], bss_end[], stack_start[], stack_end[];

static struct pins_out pins;
static uint32_t plant_says, plant_hears;
static uint8_t received[MAX_WAKE_BYTES];
static uint32_t received_length, received_taken;
static uint32_t ticks;
static double now_s;

static uint32_t semihost(uint32_t operation, uint32_t argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register uint32_t r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static uint32_t semihost_3(uint32_t operation, uint32_t first, uint32_t second, uint32_t third)
{
    const uint32_t block[] = {first, second, third};
    return semihost(operation, (uint32_t)block);
}

static uint32_t open_pins(const char *path, uint32_t mode)
{
    return semihost_3(SYS_OPEN, (uint32_t)path, mode, (uint32_t)strlen(path));
}

static void tell_plant(const void *record, size_t length)
{
    semihost_3(SYS_WRITE, plant_hears, (uint32_t)record, (uint32_t)length);
}

/* The plant has gone: tell how much of the stack was ever used, and end the emulation. */
static void end(void)
{
    const uint32_t *word = stack_start;
    while (*word == PAINT) {
        word++;
    }
    const uint32_t used = (uint32_t)((stack_end - word) * 4);
    tell_plant(&used, sizeof used);
    semihost(SYS_EXIT, EXITED);
}

static void ask_plant(void *record, size_t length)
{
    if (semihost_3(SYS_READ, plant_says, (uint32_t)record, (uint32_t)length) != 0u) {
        end();
    }
}

/* -- clock and link ------------------------------------------------------------------------------------------------ */

static void wait_for_interrupt(void)
{
    __asm__ volatile("wfi"); /* masked interrupts wake it, too */
}

/* Lets the clock run for `cycles`, and counts the ticks that end in them. */
static uint32_t sleep(uint32_t cycles)
{
    const uint32_t before = ticks;
    ALARM->value = cycles;
    TICK->ctrl = TIMER_ON;
    ALARM->ctrl = TIMER_ON;
    do {
        wait_for_interrupt();
        if (TICK->interrupt != 0u) {
            TICK->value = CYCLES_PER_TICK;
            TICK->interrupt = 1u;
            ticks++;
        }
        INTERRUPTS_DONE = TIMERS_INTERRUPT;
    } while (ALARM->interrupt == 0u);
    TICK->ctrl = 0u;
    ALARM->ctrl = 0u;
    ALARM->interrupt = 1u;
    INTERRUPTS_DONE = TIMERS_INTERRUPT;
    return ticks - before;
}

static void listen(uint32_t length)
{
    received_taken = 0u;
    INTERRUPTS_ON = LINK_INTERRUPT; /* only here: bytes that come earlier end no sleep */
    for (received_length = 0u; received_length < length; received_length++) {
        while ((LINK->state & UART_RECEIVED) == 0u) {
            wait_for_interrupt();
            INTERRUPTS_DONE = LINK_INTERRUPT;
        }
        received[received_length % MAX_WAKE_BYTES] = (uint8_t)LINK->data;
        LINK->interrupt = UART_RECEIVED;
    }
    INTERRUPTS_OFF = LINK_INTERRUPT;
}

void board_start(struct tormag_device_parameters *parameters)
{
    plant_says = open_pins("/dev/stdin", BINARY_READ);
    plant_hears = open_pins("/dev/stdout", BINARY_WRITE);
    ask_plant(parameters, sizeof *parameters);
    TICK->value = CYCLES_PER_TICK;
    LINK->divisor = 25u; /* 1 Mbaud */
    LINK->ctrl = UART_ON;
    INTERRUPTS_ON = TIMERS_INTERRUPT;
    COUNT->load = SYSTICK_TOP;
}

bool board_wait(struct tormag_sensors *sensors)
{
    struct pins_in in;
    pins.busy = SYSTICK_TOP - COUNT->value;
    COUNT->ctrl = 0u;
    tell_plant(&pins, sizeof pins);
    pins.sent = 0u;
    ask_plant(&in, sizeof in);
    const bool is_tick = in.cycles != 0u && sleep(in.cycles) != 0u;
    listen(in.bytes);
    *sensors = in.sensors;
    now_s = ((double)ticks * CYCLES_PER_TICK + (double)(CYCLES_PER_TICK - TICK->value)) / CYCLES_PER_S;
    COUNT->value = 0u;
    COUNT->ctrl = SYSTICK_ON;
    return is_tick;
}

double board_time_s(void)
{
    return now_s;
}

bool board_receive(uint8_t *byte)
{
    if (received_taken == received_length) {
        return false;
    }
    *byte = received[received_taken++ % MAX_WAKE_BYTES];
    return true;
}

void board_send(const uint8_t *bytes, size_t length)
{
    for (size_t i = 0; i < length; i++) {
        while ((LINK->state & UART_FULL) != 0u) {
        }
        LINK->data = bytes[i];
    }
    pins.sent += (uint32_t)length;
}

void board_drive(const struct tormag_device *device)
{
    pins.mode = device->mode;
    pins.faults = device->faults;
    pins.homed = device->homed;
    pins.output = device->output;
}

/* -- start-up ------------------------------------------------------------------------------------------------------ */

int main(void);

static void reset(void)
{
    uint32_t *top;
    __asm__ volatile("cpsid i\n mov %0, sp" : "=r"(top)); /* no handler: an interrupt ends a sleep, and no more */
    for (volatile uint32_t *word = stack_start; word < top; word++) {
        *word = PAINT;
    }
    memcpy(data_start, data_stored, (size_t)((uint8_t *)data_end - (uint8_t *)data_start));
    memset(bss_start, 0, (size_t)((uint8_t *)bss_end - (uint8_t *)bss_start));
    main();
}

/* A fault of the processor: the emulation ends, and the plant sees it. */
static void broken(void)
{
    semihost(SYS_EXIT, 0u);
}

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    void (*handlers[3])(void);
} VECTORS = {stack_end, {reset, broken, broken}};
