/* The part of ST's HAL and of CubeMX's main.h that the skeleton uses: declarations alone. */
#ifndef STUB_STM32_MAIN_H
#define STUB_STM32_MAIN_H
#include <stdint.h>
typedef enum { HAL_OK = 0, HAL_ERROR, HAL_BUSY, HAL_TIMEOUT } HAL_StatusTypeDef;
typedef enum { HAL_UART_STATE_READY = 0x20 } HAL_UART_StateTypeDef;
typedef enum { GPIO_PIN_RESET = 0, GPIO_PIN_SET } GPIO_PinState;
typedef struct { volatile uint32_t CNT; } TIM_TypeDef;
typedef struct { TIM_TypeDef *Instance; } TIM_HandleTypeDef;
typedef struct { volatile uint32_t NDTR; } DMA_Stream_TypeDef;
typedef struct { DMA_Stream_TypeDef *Instance; } DMA_HandleTypeDef;
typedef struct { volatile HAL_UART_StateTypeDef gState; DMA_HandleTypeDef *hdmarx; } UART_HandleTypeDef;
typedef struct { uint32_t ErrorCode; } RNG_HandleTypeDef;
typedef struct { uint32_t Init; } IWDG_HandleTypeDef;
typedef struct { uint32_t IDR; } GPIO_TypeDef;
extern TIM_HandleTypeDef htim1, htim2, htim3, htim4;
extern UART_HandleTypeDef huart2;
extern RNG_HandleTypeDef hrng;
extern IWDG_HandleTypeDef hiwdg;
extern GPIO_TypeDef *const stub_port;
#define ESTOP_GPIO_Port stub_port
#define ESTOP_Pin ((uint16_t)1)
#define LEFT_DIR_GPIO_Port stub_port
#define LEFT_DIR_Pin ((uint16_t)2)
#define RIGHT_DIR_GPIO_Port stub_port
#define RIGHT_DIR_Pin ((uint16_t)4)
#define ENABLE_GPIO_Port stub_port
#define ENABLE_Pin ((uint16_t)8)
#define BRAKE_GPIO_Port stub_port
#define BRAKE_Pin ((uint16_t)16)
#define RCC_FLAG_IWDGRST ((uint8_t)0x7D)
#define RCC_FLAG_BORRST ((uint8_t)0x79)
#define RCC_FLAG_PORRST ((uint8_t)0x7B)
int stub_reset_flag(uint8_t flag);
void stub_clear_reset_flags(void);
#define __HAL_RCC_GET_FLAG(flag) stub_reset_flag(flag)
#define __HAL_RCC_CLEAR_RESET_FLAGS() stub_clear_reset_flags()
#define TIM_CHANNEL_1 (0x00000000U)
#define TIM_CHANNEL_2 (0x00000004U)
#define TIM_CHANNEL_ALL (0x0000003CU)
#define __HAL_TIM_GET_COUNTER(handle) ((handle)->Instance->CNT)
void stub_compare(TIM_HandleTypeDef *timer, uint32_t channel, uint32_t value);
#define __HAL_TIM_SET_COMPARE(handle, channel, value) stub_compare(handle, channel, value)
#define __HAL_DMA_GET_COUNTER(handle) ((handle)->Instance->NDTR)
#define UART_IT_PE (0x100U)
#define UART_IT_ERR (0x200U)
void stub_disable_interrupt(UART_HandleTypeDef *uart, uint32_t interrupt);
#define __HAL_UART_DISABLE_IT(handle, interrupt) stub_disable_interrupt(handle, interrupt)
void __disable_irq(void);
void __enable_irq(void);
void __WFI(void);
void SystemClock_Config(void);
void MX_GPIO_Init(void);
void MX_DMA_Init(void);
void MX_USART2_UART_Init(void);
void MX_TIM1_Init(void);
void MX_TIM2_Init(void);
void MX_TIM3_Init(void);
void MX_TIM4_Init(void);
void MX_RNG_Init(void);
void MX_IWDG_Init(void);
HAL_StatusTypeDef HAL_Init(void);
HAL_StatusTypeDef HAL_TIM_Base_Start(TIM_HandleTypeDef *timer);
HAL_StatusTypeDef HAL_TIM_Encoder_Start(TIM_HandleTypeDef *timer, uint32_t channel);
HAL_StatusTypeDef HAL_TIM_PWM_Start(TIM_HandleTypeDef *timer, uint32_t channel);
HAL_StatusTypeDef HAL_UARTEx_ReceiveToIdle_DMA(UART_HandleTypeDef *uart, uint8_t *data, uint16_t size);
HAL_StatusTypeDef HAL_UART_Transmit_DMA(UART_HandleTypeDef *uart, const uint8_t *data, uint16_t size);
HAL_StatusTypeDef HAL_RNG_GenerateRandomNumber(RNG_HandleTypeDef *rng, uint32_t *number);
HAL_StatusTypeDef HAL_IWDG_Refresh(IWDG_HandleTypeDef *watchdog);
GPIO_PinState HAL_GPIO_ReadPin(GPIO_TypeDef *port, uint16_t pin);
void HAL_GPIO_WritePin(GPIO_TypeDef *port, uint16_t pin, GPIO_PinState state);
#endif
