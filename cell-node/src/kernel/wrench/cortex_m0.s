@ The wrench kernel for ARMv6-M. cortex_m0.rs prepares what it reads, and says which chains it is for.
@
@   void skinbus_wrench(const Program *program, const int16_t *positions, int16_t *jacobian, const int32_t *contact)
@
@ The compiler cannot use the carry of a shift, which is the half step of rounding: `asrs #14; adcs #0`.
@
@   r0, r1, r5   temporary                     r8 r9    force x, y
@   r2           zero, from the sine on        r10 r11  moment x, y
@   r3 r4        cosine, sine                  r12      moment z
@   r6           step of the program           [sp]     force z
@   r7           position of the joint         lr       from there to its element of J
@
@ A program: twice the index of the cell's joint; steps. The contact: force x, y, z, moment x, y, z.
    .set HANDLER, 0
    .set OFFSET_A, 4            @ 16 bits of the theta offset of the joint, below 16 bits of a
    .set LENGTH_D, 8
    .set TWIST, 12              @ the rest of what skinbus_wrench_any does
    .set SHIFT, 16
    .set STEP, 20

    .syntax unified
    .section .text.skinbus_wrench, "ax", %progbits
    .p2align 2

@ Turns a vector about z. Leaves its x in r5 and its y in r1.
.macro TURN x, y
    mov     r0, \x
    mov     r5, r0
    muls    r5, r3, r5
    muls    r0, r4, r0
    mov     r1, \y
    muls    r1, r4, r1
    subs    r5, r5, r1
    mov     r1, \y
    muls    r1, r3, r1
    adds    r1, r1, r0
    asrs    r5, r5, #14
    adcs    r5, r2
    asrs    r1, r1, #14
    adcs    r1, r2
    mov     \x, r5
    mov     \y, r1
.endm

@ Leaves the y of the turned vector in r1.
.macro TURN_Y x, y
    mov     r0, \x
    muls    r0, r4, r0
    mov     r1, \y
    muls    r1, r3, r1
    adds    r1, r1, r0
    asrs    r1, r1, #14
    adcs    r1, r2
.endm

@ Adds a product, rounded, to a component. Clobbers r1, unless it is the result.
.macro ADD product, component, result=r1
    asrs    \product, \product, #14
    mov     \result, \component
    adcs    \result, \product
    mov     \component, \result
.endm

@ Goes on to the joint below, by the code of the step.
.macro DISPATCH
    ldr     r0, [r6, #HANDLER]
    subs    r7, #2
    mov     pc, r0
.endm

.macro HANDLER_BEGIN name
    .global \name
    .type \name, %function
    .thumb_func
\name:
.endm

HANDLER_BEGIN skinbus_wrench
    push    {r4, r5, r6, r7, lr}
    subs    r2, r2, r1
    mov     lr, r2
    mov     r4, r8
    mov     r5, r9
    mov     r6, r10
    mov     r7, r11
    push    {r4, r5, r6, r7}
    sub     sp, #4
    ldmia   r3!, {r2, r4, r5}
    mov     r8, r2
    mov     r9, r4
    str     r5, [sp]
    ldmia   r3!, {r2, r4, r5}
    mov     r10, r2
    mov     r11, r4
    mov     r12, r5
    ldmia   r0!, {r7}
    adds    r7, r7, r1
    subs    r0, #STEP
    mov     r6, r0
    b       store

@ No twist, shift by a; the row further down does not read force x.
HANDLER_BEGIN skinbus_wrench_y_a
    TURN    r10, r11
    TURN_Y  r8, r9
    mov     r9, r1
    b       shift_a

@ No twist, shift by a.
HANDLER_BEGIN skinbus_wrench_a
    TURN    r10, r11
    TURN    r8, r9
shift_a:                                @ with force y in r1
    ldr     r3, [r6, #OFFSET_A]
    asrs    r3, r3, #16
    muls    r1, r3, r1
    ADD     r1, r12, r5
    ldr     r0, [sp]
    muls    r0, r3, r0
    rsbs    r0, r0, #0
    ADD     r0, r11
store:                                  @ the element of J in r5
    mov     r0, lr
    strh    r5, [r7, r0]
    adds    r6, #STEP

@ Sine and cosine of the angle: sine.rs has the polynomials.
    ldr     r1, [r6, #OFFSET_A]
    ldrh    r0, [r7]
    adds    r0, r0, r1                  @ the angle in the low 16 bits
    lsls    r1, r0, #18
    asrs    r1, r1, #18                 @ z, from the nearest quarter turn
    mov     r2, r1
    muls    r2, r1, r2
    lsrs    r2, r2, #11
    adds    r2, #1                      @ z squared
    ldr     r4, sine_5
    muls    r4, r2, r4
    asrs    r4, r4, #17
    ldr     r5, sine_3
    adds    r4, r4, r5
    muls    r4, r2, r4
    asrs    r4, r4, #17
    ldr     r5, sine_1
    adds    r4, r4, r5
    muls    r4, r1, r4
    ldr     r3, cosine_6
    muls    r3, r2, r3
    asrs    r3, r3, #17
    ldr     r5, cosine_4
    adds    r3, r3, r5
    muls    r3, r2, r3
    asrs    r3, r3, #17
    ldr     r5, cosine_2
    adds    r3, r3, r5
    muls    r3, r2, r3                  @ always negative: as an unsigned number, 2^32 more
    movs    r2, #0
    lsrs    r3, r3, #18
    adcs    r3, r2
    asrs    r4, r4, #16
    adcs    r4, r2
    lsrs    r0, r0, #14
    adcs    r0, r2                      @ the nearest quarter turn
    lsls    r0, r0, #31
    bmi     odd
    bcc     even
    rsbs    r4, r4, #0
    rsbs    r3, r3, #0
even:
    DISPATCH
odd:
    bcc     first
    rsbs    r0, r3, #0
    mov     r3, r4
    mov     r4, r0
    DISPATCH
first:
    rsbs    r0, r4, #0
    mov     r4, r3
    mov     r3, r0
    DISPATCH

    .p2align 2
sine_1:     .word   102943
sine_3:     .word   -42307
sine_5:     .word   5063
cosine_2:   .word   -40420
cosine_4:   .word   8268
cosine_6:   .word   -572

@ Twist by a quarter turn, shift by d.
HANDLER_BEGIN skinbus_wrench_ahead_d
    TURN    r10, r11
    TURN    r8, r9
    ldr     r3, [r6, #LENGTH_D]
    ldr     r0, [sp]
    str     r1, [sp]
    rsbs    r1, r0, #0
    mov     r9, r1
    muls    r0, r3, r0
    ADD     r0, r10
    mov     r1, r12
    rsbs    r1, r1, #0
    muls    r5, r3, r5
    asrs    r5, r5, #14
    adcs    r1, r5
    mov     r5, r11
    mov     r11, r1
    mov     r12, r5
    b       store

@ Twist by a quarter turn backwards, shift by d.
HANDLER_BEGIN skinbus_wrench_back_d
    TURN    r10, r11
    TURN    r8, r9
    ldr     r3, [r6, #LENGTH_D]
    ldr     r0, [sp]
    rsbs    r1, r1, #0
    str     r1, [sp]
    mov     r9, r0
    muls    r0, r3, r0
    rsbs    r0, r0, #0
    ADD     r0, r10
    mov     r1, r12
    muls    r5, r3, r5
    asrs    r5, r5, #14
    adcs    r1, r5
    mov     r5, r11
    mov     r11, r1
    rsbs    r5, r5, #0
    mov     r12, r5
    b       store

@ The other twists and shifts, one after the other.
HANDLER_BEGIN skinbus_wrench_any
    TURN    r10, r11
    TURN    r8, r9
    ldr     r0, [r6, #TWIST]
    mov     pc, r0

HANDLER_BEGIN skinbus_wrench_twist_ahead
    ldr     r0, [sp]
    rsbs    r0, r0, #0
    mov     r1, r9
    str     r1, [sp]
    mov     r9, r0
    mov     r0, r12
    rsbs    r0, r0, #0
    mov     r1, r11
    b       twisted

HANDLER_BEGIN skinbus_wrench_twist_back
    ldr     r0, [sp]
    mov     r1, r9
    rsbs    r1, r1, #0
    str     r1, [sp]
    mov     r9, r0
    mov     r0, r12
    mov     r1, r11
    rsbs    r1, r1, #0
    b       twisted

HANDLER_BEGIN skinbus_wrench_twist_half
    ldr     r0, [sp]
    rsbs    r0, r0, #0
    str     r0, [sp]
    mov     r0, r9
    rsbs    r0, r0, #0
    mov     r9, r0
    mov     r0, r11
    rsbs    r0, r0, #0
    mov     r1, r12
    rsbs    r1, r1, #0
twisted:                                @ moments y and z in r0 and r1
    mov     r11, r0
    mov     r12, r1
    ldr     r0, [r6, #SHIFT]
    mov     pc, r0

HANDLER_BEGIN skinbus_wrench_shift_a
    mov     r1, r9
    b       shift_a

HANDLER_BEGIN skinbus_wrench_shift_d
    ldr     r3, [r6, #LENGTH_D]
    mov     r0, r9
    muls    r0, r3, r0
    rsbs    r0, r0, #0
    ADD     r0, r10
    mov     r0, r8
    muls    r0, r3, r0
    ADD     r0, r11
HANDLER_BEGIN skinbus_wrench_shift_none
    mov     r5, r12
    b       store

HANDLER_BEGIN skinbus_wrench_shift_d_a
    ldr     r3, [r6, #LENGTH_D]
    ldr     r4, [r6, #OFFSET_A]
    asrs    r4, r4, #16
    mov     r5, r9
    mov     r0, r5
    muls    r0, r3, r0
    rsbs    r0, r0, #0
    ADD     r0, r10
    mov     r0, r8
    muls    r0, r3, r0
    ldr     r1, [sp]
    muls    r1, r4, r1
    subs    r0, r0, r1
    ADD     r0, r11
    muls    r4, r5, r4
    ADD     r4, r12, r5
    b       store

@ Joint 1 by way of a row without a: the last element of J is a component of the turned moment, or its negative.
HANDLER_BEGIN skinbus_wrench_last_z
    mov     r1, r12
    b       last
HANDLER_BEGIN skinbus_wrench_last_minus_z
    mov     r1, r12
    rsbs    r1, r1, #0
    b       last
HANDLER_BEGIN skinbus_wrench_last_minus_y
    TURN_Y  r10, r11
    rsbs    r1, r1, #0
    b       last
HANDLER_BEGIN skinbus_wrench_last_y
    TURN_Y  r10, r11
last:
    mov     r0, lr
    strh    r1, [r7, r0]
HANDLER_BEGIN skinbus_wrench_return
    add     sp, #4
    pop     {r4, r5, r6, r7}
    mov     r8, r4
    mov     r9, r5
    mov     r10, r6
    mov     r11, r7
    pop     {r4, r5, r6, r7, pc}
    .size skinbus_wrench, . - skinbus_wrench
