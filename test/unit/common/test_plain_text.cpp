// SPDX-License-Identifier: MIT
#include <gtest/gtest.h>

#include <random>

#include "semantic_lidar_fusion/common/plain_text.h"

namespace semantic_lidar_fusion {
namespace {

TEST(PlainText, KeepsWhatIsPrintable) {
  for (const char* text : {"", "base_link", "32FC12", "Straße", "路面", "🚗 x"}) {
    EXPECT_EQ(plainText(text), text);
  }
}

TEST(PlainText, EscapesControlsAndWhatIsNoUtf8) {
  EXPECT_EQ(plainText("a\nb\x1b[31m\x7f"), "a\\x0ab\\x1b[31m\\x7f");
  EXPECT_EQ(plainText(std::string("a\0b", 3)), "a\\x00b");
  EXPECT_EQ(plainText("\xff\xc3"), "\\xff\\xc3");
  EXPECT_EQ(plainText("\xc0\xaf"), "\\xc0\\xaf");  // not the shortest form
  EXPECT_EQ(plainText("\xc2\x85\xe2\x80\xa8"), "\\xc2\\x85\\xe2\\x80\\xa8");  // line breaks
  EXPECT_EQ(plainText("\xed\xa0\x80"), "\\xed\\xa0\\x80");  // half a surrogate pair
}

TEST(PlainText, ShortensAndKeepsBothEnds) {
  const std::string text = plainText(std::string(1000000, 'a') + "z", 90);
  EXPECT_EQ(text, std::string(60, 'a') + "...(1000001 bytes)..." + std::string(29, 'a') + "z");
}

TEST(PlainText, AnythingBecomesOneShortPrintableLine) {
  std::mt19937 random(8);
  for (int round = 0; round < 2000; ++round) {
    std::string text(random() % 300, '\0');
    for (char& c : text)
      c = static_cast<char>(round % 2 ? random() : "\xe2\x80\xa8\xf0\x9f aZ"[random() % 8]);
    const std::string plain = plainText(text);
    EXPECT_LE(plain.size(), 4 * 80u + 40u);
    for (const char c : plain) EXPECT_GE(static_cast<unsigned char>(c), 0x20) << plain;
    EXPECT_EQ(plainText(plain, 1000), plain);
  }
}

}  // namespace
}  // namespace semantic_lidar_fusion
