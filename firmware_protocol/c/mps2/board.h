/*
 * What a port supplies: a clock with a tick, a serial link, sensors and bridges. `main.c` is the firmware over it, and
 * `board.c` an example: Arm's MPS2 board as QEMU emulates it. Nothing here is called from an interrupt.
 */
#ifndef TORMAG_BOARD_H
#define TORMAG_BOARD_H

#include <stddef.h>

#include "../device.h"

/* Drives off, clock and link on. `parameters` are the device's own: calibration, serial number. */
void board_start(struct tormag_device_parameters *parameters);

/* Sleeps until the tick or bytes of the link; reads the sensors as they are then. True: the tick, every TORMAG_TICK_S. */
bool board_wait(struct tormag_sensors *sensors);

/* Time since the boot at which board_wait() returned, s. It never falls. */
double board_time_s(void);

/* The next byte that the link received; false without one. */
bool board_receive(uint8_t *byte);

/* Queues a frame's bytes on the link. Its queue takes the answers to all that board_receive() gave. */
void board_send(const uint8_t *bytes, size_t length);

/* Puts device->output at the bridges. Lamps may show its mode and faults. */
void board_drive(const struct tormag_device *device);

#endif
