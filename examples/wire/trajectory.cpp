// A scan by trajectory over the twin's wire in C++17 with plain POSIX sockets: no flexdt, no JSON library.
//
//   g++ -std=c++17 -O2 -o trajectory examples/wire/trajectory.cpp && ./trajectory [HOST [PORT [NAME]]]
//
// Submits one pose a view, waits for the job and prints the data set's folder, which
// `flexdt reconstruct FOLDER --out volume.tif` turns into a volume: dark and flat are in it.
#include <netdb.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <iostream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>

class Twin {
 public:
  Twin(const std::string& host, const std::string& port) {
    addrinfo hints{};
    hints.ai_socktype = SOCK_STREAM;
    addrinfo* found = nullptr;
    if (getaddrinfo(host.c_str(), port.c_str(), &hints, &found) != 0)
      throw std::runtime_error("no such host: " + host);
    for (addrinfo* at = found; at != nullptr && socket_ < 0; at = at->ai_next) {
      socket_ = socket(at->ai_family, at->ai_socktype, at->ai_protocol);
      if (socket_ >= 0 && connect(socket_, at->ai_addr, at->ai_addrlen) != 0) {
        close(socket_);
        socket_ = -1;
      }
    }
    freeaddrinfo(found);
    if (socket_ < 0) throw std::runtime_error("no server at " + host + ":" + port);
  }
  ~Twin() { close(socket_); }
  Twin(const Twin&) = delete;
  Twin& operator=(const Twin&) = delete;

  // Send a request; returns the answer's line, passing over events. Throws on a JSON-RPC error.
  std::string call(const std::string& method, const std::string& params) {
    const std::string id = std::to_string(++count_);
    send(R"({"jsonrpc":"2.0","id":)" + id + R"(,"method":")" + method + R"(","params":)" + params + "}\n");
    while (true) {
      const std::string line = receive();
      if (line.find(R"("method":"event")") != std::string::npos) continue;
      if (line.find(R"("error":{)") != std::string::npos) throw std::runtime_error(method + ": " + line);
      return line;
    }
  }

 private:
  void send(const std::string& text) {
    for (std::size_t sent = 0; sent < text.size();) {
      const ssize_t some = ::send(socket_, text.data() + sent, text.size() - sent, MSG_NOSIGNAL);
      if (some <= 0) throw std::runtime_error("the connection broke");
      sent += static_cast<std::size_t>(some);
    }
  }

  std::string receive() {
    std::size_t end;
    while ((end = pending_.find('\n')) == std::string::npos) {
      std::array<char, 65536> chunk;
      const ssize_t some = recv(socket_, chunk.data(), chunk.size(), 0);
      if (some <= 0) throw std::runtime_error("the server closed the connection");
      pending_.append(chunk.data(), static_cast<std::size_t>(some));
    }
    const std::string line = pending_.substr(0, end);
    pending_.erase(0, end + 1);
    return line;
  }

  int socket_ = -1;
  long count_ = 0;
  std::string pending_;
};

// The text or number behind "name": in an answer.
std::string after(const std::string& answer, const std::string& name) {
  const std::string key = "\"" + name + "\":";
  std::size_t at = answer.find(key);
  if (at == std::string::npos) throw std::runtime_error("no " + name + " in " + answer.substr(0, 200));
  at += key.size();
  if (answer[at] == '"') return answer.substr(at + 1, answer.find('"', at + 1) - at - 1);
  return answer.substr(at, answer.find_first_of(",}", at) - at);
}

int main(int count, char** words) try {
  constexpr int views = 24;
  Twin twin(count > 1 ? words[1] : "127.0.0.1", count > 2 ? words[2] : "55000");
  const std::string name = count > 3 ? words[3] : "by-trajectory";
  twin.call("session.hello", R"({"protocol":"1.0","client":"C++"})");
  twin.call("sample.set", R"({"name":"normal-5"})");
  twin.call("camera.set", R"({"mode":"HW4SW1High"})");

  std::ostringstream poses;
  for (int i = 0; i < views; ++i)
    poses << (i ? "," : "") << R"({"rot_obj":)" << i * 360.0 / views << R"(,"mag_obj":600,"tra_obj":0})";
  // "flat" is true if it is left out: the server moves the sample beside the beam and back, on a
  // path without a contact. A pose instead says where the beam is free; false takes no flat.
  const std::string job = twin.call("trajectory.submit",
      R"({"exposure_ms":20,"name":")" + name + R"(","poses":[)" + poses.str() + "]}");

  const std::string asked = R"({"job":")" + after(job, "job") + "\"}";
  std::string status = twin.call("job.status", asked), state = after(status, "state");
  while (state == "queued" || state == "running" || state == "paused") {
    std::this_thread::sleep_for(std::chrono::milliseconds(200));
    status = twin.call("job.status", asked);
    state = after(status, "state");
  }
  std::cout << state << ": " << after(status, "frames_done") << " of " << after(status, "frames_total")
            << " projections\n" << after(job, "dataset") << "\n";
} catch (const std::exception& error) {
  std::cerr << error.what() << "\n";
  return 1;
}
