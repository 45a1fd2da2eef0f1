/* STM32F4 with ST's HAL: USART2 by DMA, circular for reception, TIM2 as the microsecond counter, TIM3 and TIM4 as encoders,
 * TIM1 as the motors' PWM, IWDG. Compiled against stub headers in the tests; NOT RUN ON HARDWARE. The handles and the
 * MX_..._Init functions are what CubeMX generates for these peripherals. */
#include "port.h"

#include "main.h"

#define TICKS_PER_REV (2048u)
#define MAX_WHEEL_SPEED (8.0f)
#define TWO_PI (6.2831853f)
#define PWM_FULL (1000.0f)
#define SPEED_FILTER_S (0.01f)
#define RECEIVING_BYTES (512u)
#define SENDING_BYTES (256u)

static volatile uint8_t incoming[RECEIVING_BYTES];
static uint8_t sending[SENDING_BYTES];
static uint16_t last_count[2];

/* Memory that a reset leaves alone: the section .noinit of the linker script. */
__attribute__((section(".noinit"))) static uint64_t last_entropy;

disco_reset_cause_t port_start(disco_config_t *config)
{
    disco_reset_cause_t cause = DISCO_RESET_POWER_ON;
    if (__HAL_RCC_GET_FLAG(RCC_FLAG_IWDGRST)) {
        cause = DISCO_RESET_WATCHDOG;
    } else if (__HAL_RCC_GET_FLAG(RCC_FLAG_BORRST) && !__HAL_RCC_GET_FLAG(RCC_FLAG_PORRST)) {
        cause = DISCO_RESET_BROWN_OUT;
    }
    __HAL_RCC_CLEAR_RESET_FLAGS();
    (void)HAL_Init();
    SystemClock_Config();
    MX_GPIO_Init(); /* driver off, brake on */
    MX_DMA_Init();
    MX_USART2_UART_Init();
    MX_TIM1_Init();
    MX_TIM2_Init();
    MX_TIM3_Init();
    MX_TIM4_Init();
    MX_RNG_Init();
    (void)HAL_TIM_Base_Start(&htim2); /* 1 MHz, 32 bits */
    (void)HAL_TIM_Encoder_Start(&htim3, TIM_CHANNEL_ALL);
    (void)HAL_TIM_Encoder_Start(&htim4, TIM_CHANNEL_ALL);
    (void)HAL_TIM_PWM_Start(&htim1, TIM_CHANNEL_1);
    (void)HAL_TIM_PWM_Start(&htim1, TIM_CHANNEL_2);
    /* Circular DMA, and no interrupt of its errors, at which the HAL would end it; the interrupt at the end of a burst
     * wakes port_wait. Never HAL_UART_Receive_IT from an interrupt: it fails while HAL_UART_Transmit_DMA holds the lock. */
    __disable_irq();
    (void)HAL_UARTEx_ReceiveToIdle_DMA(&huart2, (uint8_t *)incoming, RECEIVING_BYTES);
    __HAL_UART_DISABLE_IT(&huart2, UART_IT_ERR);
    __HAL_UART_DISABLE_IT(&huart2, UART_IT_PE);
    __enable_irq();
    MX_IWDG_Init(); /* LSI / 4, reload 249: 31 ms */
    config->ticks_per_rev = TICKS_PER_REV;
    config->max_wheel_speed = MAX_WHEEL_SPEED;
    config->board_id = 0x0411u;
    return cause;
}

uint32_t port_now_us(void)
{
    return __HAL_TIM_GET_COUNTER(&htim2);
}

size_t port_receive(uint8_t *bytes, size_t most)
{
    static uint32_t taken;
    const uint32_t written = (RECEIVING_BYTES - __HAL_DMA_GET_COUNTER(huart2.hdmarx)) % RECEIVING_BYTES;
    size_t count = 0u;
    while ((count < most) && (taken != written)) {
        bytes[count++] = incoming[taken];
        taken = (taken + 1u) % RECEIVING_BYTES;
    }
    return count;
}

size_t port_send(const uint8_t *bytes, size_t count)
{
    size_t taken = (count < SENDING_BYTES) ? count : SENDING_BYTES;
    if (huart2.gState != HAL_UART_STATE_READY) {
        return 0u;
    }
    for (size_t i = 0u; i < taken; i++) {
        sending[i] = bytes[i];
    }
    return (HAL_UART_Transmit_DMA(&huart2, sending, (uint16_t)taken) == HAL_OK) ? taken : 0u;
}

uint64_t port_entropy(uint64_t *last)
{
    uint32_t low = 0u;
    uint32_t high = 0u;
    /* Where the generator fails, 0 is left, and the core refuses the start. */
    if ((HAL_RNG_GenerateRandomNumber(&hrng, &low) != HAL_OK) || (HAL_RNG_GenerateRandomNumber(&hrng, &high) != HAL_OK)) {
        low = high = 0u;
    }
    *last = last_entropy;
    last_entropy = ((uint64_t)high << 32) | low;
    return last_entropy;
}

void port_measure(port_measurement_t *measurement)
{
    static uint32_t measured_us;
    disco_inputs_t *inputs = &measurement->inputs;
    /* Cycles that were late come one after the other: the time that passed is not always the cycle's. */
    const uint32_t now_us = port_now_us();
    const float passed_s = (float)(now_us - measured_us) * 1.0e-6f;
    measured_us = now_us;
    const uint16_t count[2] = {(uint16_t)__HAL_TIM_GET_COUNTER(&htim3), (uint16_t)__HAL_TIM_GET_COUNTER(&htim4)};
    for (uint8_t side = 0u; side < 2u; side++) {
        /* The timer has 16 bits: the difference is right as long as fewer than 2^15 pass in a cycle. */
        const int16_t moved = (int16_t)(uint16_t)(count[side] - last_count[side]);
        last_count[side] = count[side];
        inputs->ticks[side] += (uint32_t)(int32_t)moved;
        const float angle = (float)moved * (TWO_PI / (float)TICKS_PER_REV);
        inputs->wheel_speed[side] += (angle - (inputs->wheel_speed[side] * passed_s)) / SPEED_FILTER_S;
        inputs->encoder_valid[side] = true;
        inputs->temperature[side] = 25.0f;
    }
    inputs->estop_button = HAL_GPIO_ReadPin(ESTOP_GPIO_Port, ESTOP_Pin) == GPIO_PIN_RESET; /* a broken wire stops */
}

void port_drive(const disco_outputs_t *outputs)
{
    /* Feed-forward alone: a speed loop of your own goes here, or into a timer's interrupt at 10 kHz. */
    float part[2];
    const float setpoint[2] = {outputs->left_setpoint, outputs->right_setpoint};
    for (uint8_t side = 0u; side < 2u; side++) {
        part[side] = outputs->driver_enabled ? setpoint[side] * (PWM_FULL / MAX_WHEEL_SPEED) : 0.0f;
    }
    __HAL_TIM_SET_COMPARE(&htim1, TIM_CHANNEL_1, (uint32_t)(part[0] < 0.0f ? -part[0] : part[0]));
    __HAL_TIM_SET_COMPARE(&htim1, TIM_CHANNEL_2, (uint32_t)(part[1] < 0.0f ? -part[1] : part[1]));
    HAL_GPIO_WritePin(LEFT_DIR_GPIO_Port, LEFT_DIR_Pin, part[0] < 0.0f ? GPIO_PIN_SET : GPIO_PIN_RESET);
    HAL_GPIO_WritePin(RIGHT_DIR_GPIO_Port, RIGHT_DIR_Pin, part[1] < 0.0f ? GPIO_PIN_SET : GPIO_PIN_RESET);
    HAL_GPIO_WritePin(ENABLE_GPIO_Port, ENABLE_Pin, outputs->driver_enabled ? GPIO_PIN_SET : GPIO_PIN_RESET);
    HAL_GPIO_WritePin(BRAKE_GPIO_Port, BRAKE_Pin, outputs->brake ? GPIO_PIN_SET : GPIO_PIN_RESET);
}

void port_feed_watchdog(void)
{
    (void)HAL_IWDG_Refresh(&hiwdg);
}

bool port_load(uint8_t *record)
{
    (void)record;
    return false;
}

/* Parameters last until the next start. To erase flash takes longer than the watchdog allows and stops all code in the same
 * bank, and a record written over another one is neither of the two: keep it in an EEPROM or FRAM. */
void port_store(const uint8_t *record)
{
    (void)record;
}

void port_wait(void)
{
    __WFI(); /* SysTick of the HAL wakes it each millisecond */
}
